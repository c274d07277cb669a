"""How right one rollout is, in a few numbers: the measures that variants of a scene are compared by."""

from collections.abc import Mapping

import numpy as np

from eddies.analysis.against_truth import EDGES, last_invariants, pdf_divergence, sampling_floor
from eddies.analysis.drifts import drifts
from eddies.analysis.errors import normalized_l2
from eddies.analysis.lagrangian import differences, of_both
from eddies.analysis.rollout import Rollout
from eddies.measures import MEASURES


def accuracy(run: Rollout) -> dict[str, float | None]:
    """All MEASURES and `end`, the last common time over T; None for what the rollout or the truth does not reach.

    The velocity error, the normalised L2 norm by particle, is interpolated linearly between frames. That at the end,
    spectrum, energy, divergences, drifts and counts are those of the last of them, Lagrangian statistics those until
    then, and of a rollout that is complete alone: at an earlier time than the others' they would not be comparable.
    """
    measures: dict[str, float | None] = dict.fromkeys(MEASURES)
    try:
        end = float(run.common.times[-1]) / run.turnover
    except ValueError:  # not one finite frame
        return measures | {"end": None}
    measures |= _early(run)
    if run.status == "complete" and not np.isfinite(run.broken):
        measures |= _at_the_end(run)
    return measures | {"end": end}


def _early(run: Rollout) -> Mapping[str, float | None]:
    start = run.pair(0, "acceleration")
    times = {"velocity_error_early": run.reference["kolmogorov_time"], "velocity_error_half": run.turnover / 2}
    errors = {name: velocity_error_at(run, time) for name, time in times.items()}
    return errors | {"acceleration_error": float(normalized_l2(start.model, start.truth))}


def velocity_error_at(run: Rollout, time: float) -> float | None:
    """Normalised L2 error of the velocity, by particle, at a time; None before the first or after the last frame."""
    times = run.common.times
    above = int(np.searchsorted(times, time))
    if above == times.size or time < times[0]:
        return None
    around = [index for index in (above - 1, above) if index >= 0]
    pairs = [run.pair(index, "velocity") for index in around]
    errors = [float(normalized_l2(pair.model, pair.truth)) for pair in pairs]
    return float(np.interp(time, times[around], errors))


def _at_the_end(run: Rollout) -> Mapping[str, float | None]:
    last = run.common.times.size - 1
    velocity, acceleration = (run.pair(last, name) for name in ("velocity", "acceleration"))
    found: dict[str, float | None] = {
        "velocity_error_end": float(normalized_l2(velocity.model, velocity.truth)),
        "energy_ratio": float(np.sum(velocity.model**2, dtype=float) / np.sum(velocity.truth**2, dtype=float)),
        "velocity_kl": pdf_divergence(velocity, EDGES["velocity"]),
        "velocity_kl_floor": sampling_floor(velocity, EDGES["velocity"]),
        "acceleration_kl": pdf_divergence(acceleration, EDGES["acceleration"]),
        "acceleration_kl_floor": sampling_floor(acceleration, EDGES["acceleration"]),
        **{name + end: both[of] for name, both in drifts(run).items()
           for end, of in (("", "model"), ("_floor", "truth"))},
        **differences(*of_both(run.model, run.truth, run.common, run.length)),
    }
    if last in run.spectral():
        spectra = run.spectra_at(last)
        found |= {"spectrum_error": spectra.error("model", run.filter_wavenumber),
                  "spectrum_error_floor": spectra.error("truth", run.filter_wavenumber)}
    if run.reconstructions is not None:
        invariants = last_invariants(run)
        found |= {"qr_kl": invariants.divergence, "qr_kl_floor": invariants.floor}
    return found
