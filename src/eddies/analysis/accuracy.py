"""How right one rollout is, in a few numbers: the measures that variants of a scene are compared by."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from eddies.analysis.against_truth import (EDGES, CommonFrames, ParticleFrames, first_broken_time,
                                           invariant_statistics, particle_pair, pdf_divergence, sampling_floor)
from eddies.analysis.disorder import count_variance
from eddies.analysis.errors import normalized_l2
from eddies.analysis.path_statistics import differences, of_both
from eddies.analysis.rollout_spectra import RolloutSpectra
from eddies.measures import MEASURES


@dataclass(frozen=True)
class StoredRollout:
    """A rollout as stored: trajectories of model and truth, spectra, the side of the box, and the flow's scales.

    turnover: T; kolmogorov_time: t_eta when the tracers start; filter_wavenumber: k_d = pi/d.
    """

    model: ParticleFrames
    truth: ParticleFrames
    spectra: RolloutSpectra
    length: float
    turnover: float
    kolmogorov_time: float
    filter_wavenumber: float


def accuracy(run: StoredRollout, complete: bool) -> dict[str, float | None]:
    """All MEASURES and `end`, the last common time over T; None for what the rollout or the truth does not reach.

    The velocity error, the normalised L2 norm by particle, is interpolated linearly between frames. That at the end,
    spectrum, energy, divergences and counts are those of the last of them, Lagrangian statistics those until then, and
    of a rollout that is `complete` alone: at an earlier time than the others' they would not be comparable.
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


def _at_the_end(run: StoredRollout, common: CommonFrames) -> Mapping[str, float | None]:
    last = common.times.size - 1
    velocity = particle_pair(run.model, run.truth, common, last, "velocity")
    acceleration = particle_pair(run.model, run.truth, common, last, "acceleration")
    position = particle_pair(run.model, run.truth, common, last, "position")
    spectra = run.spectra.at(float(common.times[last]))
    # Only where a filtered field is stored is there a spectrum.
    at_the_end = abs(spectra.time - common.times[last]) <= 1e-6 * max(1.0, spectra.time)
    final = CommonFrames(common.model[-1:], common.truth[-1:], common.times[-1:])
    # Without a kernel there are no gradients.
    known = "velocity_gradient" in run.model.columns
    invariants = invariant_statistics(run.model, run.truth, final) if known else None
    return {
        "velocity_error_end": float(normalized_l2(velocity.model, velocity.truth)),
        "spectrum_error": spectra.error("model", run.filter_wavenumber) if at_the_end else None,
        "spectrum_error_floor": spectra.error("truth", run.filter_wavenumber) if at_the_end else None,
        "energy_ratio": float(np.sum(velocity.model**2, dtype=float) / np.sum(velocity.truth**2, dtype=float)),
        "velocity_kl": pdf_divergence(velocity, EDGES["velocity"]),
        "velocity_kl_floor": sampling_floor(velocity, EDGES["velocity"]),
        "acceleration_kl": pdf_divergence(acceleration, EDGES["acceleration"]),
        "acceleration_kl_floor": sampling_floor(acceleration, EDGES["acceleration"]),
        "qr_kl": invariants and invariants.divergence,
        "qr_kl_floor": invariants and invariants.floor,
        "count_variance_ratio": (count_variance(position.model, run.length)
                                 / count_variance(position.truth, run.length)),
        **differences(*of_both(run.model, run.truth, common, run.length)),
    }
