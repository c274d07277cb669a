"""A rollout of the particle model compared with the true tracers: time series, PDFs, invariants.

Trajectories and field series are objects with `.times` and `.read(frame, column)`, so frames are read one by
one and never all held at once. `CommonFrames` pairs the frames of model and truth; the truth may end earlier.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from eddies.analysis.errors import normalized_l2
from eddies.analysis.pdfs import bin_edges, bin_probabilities, kl_divergence, sampling_divergence, standardized
from eddies.analysis.velocity_gradients import ConditionalVelocity, InvariantBins, enstrophy_scale, invariants

# Bins of the PDFs, in standard deviations of the truth.
EDGES = {"velocity": bin_edges(5, 60), "acceleration": bin_edges(8, 80)}


class Frames(Protocol):
    """A trajectory or a field series as stored."""

    times: np.ndarray

    def read(self, frame: int, column: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Rows (or planes) start to stop of one column (or field variable) of one frame."""


class ParticleFrames(Frames, Protocol):
    """A trajectory as stored."""

    columns: Collection[str]


@dataclass(frozen=True)
class CommonFrames:
    """Frames of model and truth at the same times: indices and times, all (m,)."""

    model: np.ndarray
    truth: np.ndarray
    times: np.ndarray

    @classmethod
    def of(cls, model: Frames, truth: Frames, until: float = np.inf) -> "CommonFrames":
        """Pair the frames before `until` whose times agree to 1e-6; raises ValueError if there is none."""
        gap = np.abs(model.times[:, None] - truth.times[None, :])
        same = gap <= 1e-6 * max(1.0, np.ptp(model.times))
        rows, columns = np.nonzero(same & (model.times < until)[:, None])
        if rows.size == 0:
            raise ValueError("model and truth have no finite frame at a common time")
        return cls(rows, columns, model.times[rows])

    def spread(self, count: int) -> np.ndarray:
        """At most `count` positions in this list, evenly spread from the first to the last."""
        return np.unique(np.rint(np.linspace(0, self.times.size - 1, count)).astype(int))


@dataclass(frozen=True)
class Pair:
    """One quantity of model and truth at one time."""

    time: float
    model: np.ndarray
    truth: np.ndarray


def first_broken_time(model: Frames) -> float:
    """Time of the first frame with a velocity or acceleration that is not finite; infinity without one."""
    for frame, time in enumerate(model.times):
        if not all(np.isfinite(model.read(frame, column)).all() for column in ("velocity", "acceleration")):
            return float(time)
    return np.inf


def particle_pair(model: Frames, truth: Frames, common: CommonFrames, index: int, column: str) -> Pair:
    """Column of both at the common frame `index`, rows in id order."""
    return Pair(float(common.times[index]), model.read(int(common.model[index]), column),
                truth.read(int(common.truth[index]), column))


def particle_series(frames: ParticleFrames, chosen: Sequence[int]) -> dict[str, np.ndarray]:
    """Columns over the chosen frames of one run: time, energy 1/2 <v.v>, density_rms where a density is stored."""
    columns = {"energy": np.array([0.5 * np.mean(np.sum(frames.read(int(frame), "velocity") ** 2, axis=1))
                                   for frame in chosen])}
    if "density" in frames.columns:
        columns["density_rms"] = np.array([np.std(frames.read(int(frame), "density")) for frame in chosen])
    return {"time": frames.times[np.asarray(chosen)], **columns}


def error_series(model: Frames, truth: Frames, common: CommonFrames) -> dict[str, np.ndarray]:
    """Columns over the common frames: time, velocity_error (normalised L2), velocity_kl, acceleration_kl, and the
    velocity error no_force of particles that keep the velocity of the first of them."""
    rows, first = [], truth.read(int(common.truth[0]), "velocity")
    for index in range(common.times.size):
        velocity = particle_pair(model, truth, common, index, "velocity")
        acceleration = particle_pair(model, truth, common, index, "acceleration")
        rows.append((velocity.time, normalized_l2(velocity.model, velocity.truth),
                     pdf_divergence(velocity, EDGES["velocity"]),
                     pdf_divergence(acceleration, EDGES["acceleration"]), normalized_l2(first, velocity.truth)))
    names = ("time", "velocity_error", "velocity_kl", "acceleration_kl", "no_force")
    return dict(zip(names, np.array(rows).T))


def pdf_divergence(pair: Pair, edges: np.ndarray) -> float:
    """Forward KL divergence of the PDFs of all components, both standardised by the truth."""
    return kl_divergence(bin_probabilities(standardized(pair.truth), edges),
                         bin_probabilities(standardized(pair.model, pair.truth), edges))


def sampling_floor(pair: Pair, edges: np.ndarray) -> float:
    """The divergence of that PDF between two independent samples of the truth; that of a model whose particles are
    still where those of the truth are can be smaller."""
    values = standardized(pair.truth)
    return sampling_divergence(len(values), lambda rows: bin_probabilities(values[rows], edges))


@dataclass(frozen=True)
class InvariantStatistics:
    """Q-R statistics of both runs: cell probabilities at one time, with the divergence between two samples of the truth
    (`sampling_floor`), and the mean motion until then."""

    bins: InvariantBins
    model: np.ndarray
    truth: np.ndarray
    floor: float
    model_flow: ConditionalVelocity | None
    truth_flow: ConditionalVelocity | None

    @property
    def divergence(self) -> float:
        """Forward KL divergence of the joint PDFs."""
        return kl_divergence(self.truth, self.model)


def invariant_statistics(model: Frames, truth: Frames, common: CommonFrames) -> InvariantStatistics:
    """Joint PDF of (Q, R) at the last common frame and conditional mean (dQ/dt, dR/dt) over all common
    frames.

    Both runs are normalised by the truth's <Q_w> at the time, so a wrong amplitude of the model shows. The
    flow is None with fewer than two common frames.
    """
    last = particle_pair(model, truth, common, common.times.size - 1, "velocity_gradient")
    scale = enstrophy_scale(last.truth)
    model_plane, truth_plane = (normalized_invariants(run, scale) for run in (last.model, last.truth))
    bins = InvariantBins.covering(*truth_plane)
    flows = _conditional_flows(model, truth, common, bins) if common.times.size > 1 else (None, None)
    probabilities = bins.probabilities(*model_plane), bins.probabilities(*truth_plane)
    floor = sampling_divergence(len(last.truth), lambda rows: bins.probabilities(*(part[rows] for part in truth_plane)))
    return InvariantStatistics(bins, *probabilities, floor, *flows)


def normalized_invariants(gradient: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Q and R (n,) of velocity gradients (n, 3, 3) in units of <Q_w> = `scale`."""
    second, third = invariants(gradient)
    return second / scale, third / scale**1.5


def _conditional_flows(model: Frames, truth: Frames, common: CommonFrames,
                       bins: InvariantBins) -> tuple[ConditionalVelocity, ConditionalVelocity]:
    flows = ConditionalVelocity(bins.coarser()), ConditionalVelocity(bins.coarser())
    before = None
    for index in range(common.times.size):
        pair = particle_pair(model, truth, common, index, "velocity_gradient")
        after = pair.time, enstrophy_scale(pair.truth), [invariants(run) for run in (pair.model, pair.truth)]
        if before is not None:
            interval, scale = after[0] - before[0], (before[1] + after[1]) / 2
            for flow, *both in zip(flows, before[2], after[2]):
                flow.add(*both, interval, scale)
        before = after
    return flows
