"""Comparison of a rollout with the true tracers: time series, PDFs, and invariants of the velocity gradient."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eddies.analysis.errors import fluctuations, velocity_error
from eddies.analysis.pdfs import bin_edges, bin_probabilities, kl_divergence, sampling_divergence, standardized
from eddies.analysis.rollout import Frames, Pair, Rollout
from eddies.analysis.velocity_gradients import ConditionalVelocity, InvariantBins, Invariants

# Edges of the bins of the PDFs, in standard deviations of the truth.
EDGES = {"velocity": bin_edges(5, 60), "acceleration": bin_edges(8, 80)}


def mean_energy(frames: Frames, frame: int) -> float:
    """Return the kinetic energy <v'.v'>/2 of the particles in a frame. v' is the velocity minus its mean."""
    return 0.5 * float(np.mean(np.sum(fluctuations(frames.read(int(frame), "velocity")) ** 2, axis=1)))


def particle_series(frames: Frames, chosen: Sequence[int]) -> dict[str, np.ndarray]:
    """Return time series over the `chosen` frame numbers, by name.

    Names are `time`, `energy` (`mean_energy`) and, if a density is stored, `density_rms` for its standard deviation.
    """
    columns = {"time": frames.times[np.asarray(chosen)],
               "energy": np.array([mean_energy(frames, frame) for frame in chosen])}
    if "density" in frames.columns:
        columns["density_rms"] = np.array([np.std(frames.read(int(frame), "density")) for frame in chosen])
    return columns


def error_series(run: Rollout) -> dict[str, np.ndarray]:
    """Return time series over the common frames of model and truth, by name.

    Names are `time`, `velocity_error`, `no_force`, `velocity_kl` and `acceleration_kl`. `velocity_error` has values of
    the function of this name. `no_force` is this error for particles that keep the true velocity of the first common
    frame. `velocity_kl` and `acceleration_kl` are values of `pdf_divergence`.
    """
    rows, first = [], run.pair(0, "velocity").truth
    for index, time in enumerate(run.common.times):
        velocity, acceleration = run.pair(index, "velocity"), run.pair(index, "acceleration")
        rows.append((time, velocity_error(velocity.model, velocity.truth),
                     pdf_divergence(velocity, EDGES["velocity"]),
                     pdf_divergence(acceleration, EDGES["acceleration"]), velocity_error(first, velocity.truth)))
    names = ("time", "velocity_error", "velocity_kl", "acceleration_kl", "no_force")
    return dict(zip(names, np.array(rows).T))


def pdf_divergence(pair: Pair, edges: np.ndarray) -> float:
    """Return the forward KL divergence between the PDFs of truth and model.

    Each PDF counts the values of all components. The values of both are standardised with the mean and the standard
    deviation of the truth. `edges` are the edges of the bins for these standardised values.
    """
    return kl_divergence(bin_probabilities(standardized(pair.truth), edges),
                         bin_probabilities(standardized(pair.model, pair.truth), edges))


def sampling_floor(pair: Pair, edges: np.ndarray) -> float:
    """Return the expected `pdf_divergence` between two independent samples of the truth, each as large as the truth.

    The divergence of a model can be below this floor while its particles are still near the true ones, because the
    samples of model and truth are then not independent.
    """
    values = standardized(pair.truth)
    return sampling_divergence(len(values), lambda rows: bin_probabilities(values[rows], edges))


@dataclass(frozen=True)
class InvariantStatistics:
    """Joint statistics of the invariants Q and R of the velocity gradient at one time.

    `model` and `truth` are the probabilities of the bins. `floor` is the expected divergence between two independent
    samples of the truth.
    """

    bins: InvariantBins
    model: np.ndarray
    truth: np.ndarray
    floor: float

    @classmethod
    def of(cls, model: Invariants, truth: Invariants) -> "InvariantStatistics":
        """Return the statistics of model and truth.

        In both, Q is in units of <Q_w> of the truth, and R in units of <Q_w>^(3/2) (see `enstrophy_scale`). So a wrong
        amplitude of the model changes its PDF.
        """
        model_plane, truth_plane = (run.normalized(truth.scale) for run in (model, truth))
        bins = InvariantBins.covering(*truth_plane)
        floor = sampling_divergence(len(truth.second),
                                    lambda rows: bins.probabilities(*(part[rows] for part in truth_plane)))
        return cls(bins, bins.probabilities(*model_plane), bins.probabilities(*truth_plane), floor)

    @property
    def divergence(self) -> float:
        """Forward KL divergence between the joint PDFs of truth and model."""
        return kl_divergence(self.truth, self.model)


def last_invariants(run: Rollout) -> InvariantStatistics:
    """Return the Q-R statistics at the last common frame of a rollout that has a kernel."""
    return InvariantStatistics.of(*run.both(run.invariants, -1))


def conditional_flows(run: Rollout, bins: InvariantBins) -> tuple[ConditionalVelocity, ConditionalVelocity] | None:
    """Return the mean (dQ/dt, dR/dt) given (Q, R), first of the model and then of the truth, over all common frames.

    Return None if there are fewer than two common frames. Rates are finite differences between successive frames. The
    units of Q, R and the rates are powers of <Q_w> of the truth, averaged over the two frames of a difference.
    """
    times = run.common.times
    if times.size < 2:
        return None
    flows = ConditionalVelocity(bins.coarser()), ConditionalVelocity(bins.coarser())
    before = run.both(run.invariants, 0)
    for index in range(1, times.size):
        after = run.both(run.invariants, index)
        for flow, *both in zip(flows, before, after):
            flow.add(*both, times[index] - times[index - 1], (before[1].scale + after[1].scale) / 2)
        before = after
    return flows
