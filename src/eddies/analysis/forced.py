"""Averages of a forced rollout, and those of the stationary state of its ground truth."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from eddies.analysis.against_truth import EDGES, mean_energy
from eddies.analysis.block_averages import Blocks, Estimate
from eddies.analysis.errors import spectrum_error
from eddies.analysis.isotropic_turbulence import StationarySpan
from eddies.analysis.pdfs import bin_probabilities, kl_divergence, standardized
from eddies.analysis.rollout import Frames, Rollout, second_half
from eddies.analysis.velocity_gradients import InvariantBins, Invariants
from eddies.spectral.mode_operators import gaussian_transfer


def forced_averages(run: Rollout, span: StationarySpan) -> tuple[dict[str, Any], dict[str, dict[str, np.ndarray]]]:
    """Return statistics of a forced rollout as numbers and as small tables. Both are empty if the model has no finite
    frame.

    Averages of the model are over the second half of the time before `run.broken`. They are compared with averages over
    `span`, the stationary state of the ground truth.
    """
    frames, turnover = run.before_broken("model"), run.turnover
    if not len(frames):
        return {}, {}
    times, late = run.model.times[frames], run.late
    model = averages(run.model, late, turnover, "model")
    flow, deviation = filtered_energy(run, span)
    wavenumber, spectra, error = mean_spectra(run, span)
    shares = {}
    for column, edges in EDGES.items():
        values = np.concatenate([standardized(run.model.read(frame, column)) for frame in late])
        shares[column] = (bin_probabilities(standardized(run.truth.read(0, column)), edges),
                          bin_probabilities(values, edges))
    numbers = {
        "energy": {**model["energy"], "stationary flow": flow.value, "its standard error": flow.error,
                   "its deviation": deviation},
        "acceleration_rms": {**model["acceleration_rms"],
                             "flow at the start": float(np.std(run.truth.read(0, "acceleration")))},
        "spectrum_error": {"model": error.value, "standard error": error.error},
        **{f"{column}_kl": kl_divergence(*both) for column, both in shares.items()},
        "qr_kl": None if run.invariants is None else invariant_divergence(
            [run.invariants["model"][int(frame)] for frame in late], run.invariants["truth"][0])}
    if run.powers[1] > 0 and run.truth.times[-1] >= times[-1] * (1 - 1e-9):
        truth = averages(run.truth, second_half(run.truth.times, times[-1]), turnover, "true tracers")
        numbers |= {f"true_{name}": values for name, values in truth.items()}
    numbers["average_from"] = float(run.model.times[late[0]] / turnover)
    return numbers, {
        "forced_spectra": {"wavenumber": wavenumber, "energy_flow": spectra[0], "energy_model": spectra[1]},
        "forced_accelerations": dict(zip(("truth", "model"), shares["acceleration"]))}


def averages(run: Frames, frames: np.ndarray, turnover: float, whose: str) -> dict[str, dict[str, float]]:
    """Return statistics over `frames` of the kinetic energy and of the rms of an acceleration component.

    The mean has the text `whose` as its key. The other keys are "standard error", "trend per turnover", "error of the
    trend", and "deviation" for the standard deviation in time.
    """
    blocks, found = Blocks.of(run.times[frames] / turnover, 1.0), {}
    samples = {"energy": np.array([mean_energy(run, frame) for frame in frames]),
               "acceleration_rms": np.array([np.std(run.read(frame, "acceleration")) for frame in frames])}
    for name, values in samples.items():
        mean, slope = blocks.mean(values), blocks.trend(values)
        found[name] = {whose: mean.value, "standard error": mean.error, "trend per turnover": slope.value,
                       "error of the trend": slope.error, "deviation": float(values.std())}
    return found


def invariant_divergence(model: Sequence[Invariants], flow: Invariants) -> float:
    """Return the forward KL divergence between the joint PDFs of Q and R in the flow and in all frames of the model.

    Q and R of each frame are in units of its own <Q_w> and <Q_w>^(3/2).
    """
    true_plane, *planes = (found.normalized(found.scale) for found in (flow, *model))
    bins = InvariantBins.covering(*true_plane)
    return kl_divergence(bins.probabilities(*true_plane), bins.probabilities(*np.concatenate(planes, axis=1)))


def _transfer(run: Rollout, span: StationarySpan) -> np.ndarray:
    """Return, for each shell, the fraction of its energy that the filter keeps, (shells,)."""
    return gaussian_transfer(np.arange(span.spectra.shape[1]) ** 2, run.filter_width) ** 2


def filtered_energy(run: Rollout, span: StationarySpan) -> tuple[Estimate, float]:
    """Return the mean energy of the filtered flow over its stationary span, and its standard deviation in time."""
    energy = span.spectra @ _transfer(run, span)
    return span.block_mean(energy), span.average(energy)[1]


def mean_spectra(run: Rollout, span: StationarySpan) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray], Estimate]:
    """Return the wavenumbers, the mean spectra of filtered flow and model, and the spectrum error of the model.

    The wavenumbers and each spectrum are (shells,).
    """
    chosen = run.late_spectra()
    spectra = np.array([run.spectra["model"][int(frame)] for frame in chosen])
    known = min(spectra.shape[1], span.spectra.shape[1])
    spectra, flow = spectra[:, :known], (_transfer(run, span) * span.spectrum)[:known]
    blocks = Blocks.of(run.model.times[chosen] / run.turnover, 1.0)
    error = blocks.of_mean(spectra, lambda mean: spectrum_error(mean, flow, run.filter_wavenumber))
    return np.arange(known), (flow, blocks.means(spectra).mean(axis=0)), error
