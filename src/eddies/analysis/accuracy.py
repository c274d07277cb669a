"""How right one rollout is, in a few numbers: the measures that variants of a scene are compared by."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from eddies.analysis.against_truth import (EDGES, CommonFrames, Frames, first_broken_time, invariant_statistics,
                                           particle_pair, pdf_divergence, spectra_pair)
from eddies.analysis.errors import normalized_l2
from eddies.analysis.spectra import spectrum_error

# Name of each measure and what it is; zero is perfect but for the energy ratio. In the order of tables and figures.
MEASURES = {
    "velocity_error_early": "velocity error at t_η",
    "velocity_error_half": "velocity error at T/2",
    "spectrum_error": "spectrum error, k ≤ k_d/2",
    "energy_ratio": "energy, model / truth",
    "velocity_kl": "KL velocity",
    "acceleration_kl": "KL acceleration",
    "qr_kl": "KL Q–R",
    "acceleration_error": "acceleration error at the start",
}


@dataclass(frozen=True)
class StoredRollout:
    """A rollout as stored: trajectories and field series of model and truth, and the flow's scales.

    turnover: T; kolmogorov_time: t_eta when the tracers start; filter_wavenumber: k_d = pi/d.
    """

    model: Frames
    truth: Frames
    model_field: Frames
    truth_field: Frames
    turnover: float
    kolmogorov_time: float
    filter_wavenumber: float


def accuracy(run: StoredRollout, complete: bool) -> dict[str, float | None]:
    """All MEASURES and `end`, the last common time over T; None for what the rollout or the truth does not reach.

    The velocity error, the normalised L2 norm by particle, is interpolated linearly between frames. Spectrum, energy
    and divergences are those at the end, and of a rollout that is `complete` alone: at an earlier time than the others'
    they would not be comparable.
    """
    broken = first_broken_time(run.model)
    measures: dict[str, float | None] = dict.fromkeys(MEASURES)
    try:
        common = CommonFrames.of(run.model, run.truth, broken)
    except ValueError:  # not one finite frame
        return measures | {"end": None}
    measures |= _early(run, common)
    if complete and not np.isfinite(broken):
        measures |= _at_the_end(run, common)
    return measures | {"end": float(common.times[-1]) / run.turnover}


def _early(run: StoredRollout, common: CommonFrames) -> Mapping[str, float | None]:
    start = particle_pair(run.model, run.truth, common, 0, "acceleration")
    times = {"velocity_error_early": run.kolmogorov_time, "velocity_error_half": run.turnover / 2}
    errors = {name: velocity_error_at(run, common, time) for name, time in times.items()}
    return errors | {"acceleration_error": float(normalized_l2(start.model, start.truth))}


def velocity_error_at(run: StoredRollout, common: CommonFrames, time: float) -> float | None:
    """Normalised L2 error of the velocity, by particle, at a time; None before the first or after the last frame."""
    above = int(np.searchsorted(common.times, time))
    if above == common.times.size or time < common.times[0]:
        return None
    around = [index for index in (above - 1, above) if index >= 0]
    pairs = [particle_pair(run.model, run.truth, common, index, "velocity") for index in around]
    errors = [float(normalized_l2(pair.model, pair.truth)) for pair in pairs]
    return float(np.interp(time, common.times[around], errors))


def _at_the_end(run: StoredRollout, common: CommonFrames) -> Mapping[str, float]:
    last = common.times.size - 1
    velocity = particle_pair(run.model, run.truth, common, last, "velocity")
    acceleration = particle_pair(run.model, run.truth, common, last, "acceleration")
    until = float(common.times[last]) + 1e-6 * max(1.0, float(common.times[last]))
    fields = CommonFrames.of(run.model_field, run.truth_field, until)
    spectra = spectra_pair(run.model_field, run.truth_field, fields, fields.times.size - 1)
    final = CommonFrames(common.model[-1:], common.truth[-1:], common.times[-1:])
    return {
        "spectrum_error": spectrum_error(spectra.wavenumber, spectra.model, spectra.truth,
                                         max(1.0, run.filter_wavenumber / 2)),
        "energy_ratio": float(np.sum(velocity.model**2, dtype=float) / np.sum(velocity.truth**2, dtype=float)),
        "velocity_kl": pdf_divergence(velocity, EDGES["velocity"]),
        "acceleration_kl": pdf_divergence(acceleration, EDGES["acceleration"]),
        "qr_kl": invariant_statistics(run.model, run.truth, final).divergence,
    }
