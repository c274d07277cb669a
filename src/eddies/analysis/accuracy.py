"""Accuracy of a rollout in a few numbers, by which the variants of a scene are compared."""

from collections.abc import Mapping

import numpy as np

from eddies.analysis.against_truth import EDGES, last_invariants, pdf_divergence, sampling_floor
from eddies.analysis.disorder import drifts
from eddies.analysis.errors import fluctuations, normalized_l2, velocity_error
from eddies.analysis.lagrangian import differences, of_both
from eddies.analysis.rollout import Rollout
from eddies.measures import MEASURES


def accuracy(run: Rollout) -> dict[str, float | None]:
    """Return the measures of a rollout by their keys in MEASURES, and the end of the comparison by the key `end`.

    The end is the last time that model and truth have in common, in units of the turnover time T. A measure is None if
    its data are missing, for example because the rollout or the truth ends too early. Velocity errors are normalised L2
    errors over all particles; they and the energy leave the mean velocity out. Those at the Kolmogorov time t_eta and
    at T/2 are interpolated linearly between frames. The acceleration error is that of the first common frame. The other
    measures are taken at the last common frame or, if they are Lagrangian statistics, over all common frames. These are
    None for a rollout that stops early or has a frame that is not finite, because such a rollout ends earlier than the
    others.
    """
    measures: dict[str, float | None] = dict.fromkeys(MEASURES)
    try:
        end = float(run.common.times[-1]) / run.turnover
    except ValueError:  # no finite frame
        return measures | {"end": None}
    start = run.pair(0, "acceleration")
    measures |= {"velocity_error_early": _velocity_error_at(run, run.reference["kolmogorov_time"]),
                 "velocity_error_half": _velocity_error_at(run, run.turnover / 2),
                 "acceleration_error": normalized_l2(start.model, start.truth)}
    if run.status == "complete" and not np.isfinite(run.broken):
        measures |= _at_the_end(run)
    return measures | {"end": end}


def _velocity_error_at(run: Rollout, time: float) -> float | None:
    times = run.common.times
    above = int(np.searchsorted(times, time))
    if above == times.size or time < times[0]:
        return None
    around = [index for index in (above - 1, above) if index >= 0]
    pairs = [run.pair(index, "velocity") for index in around]
    return float(np.interp(time, times[around], [velocity_error(pair.model, pair.truth) for pair in pairs]))


def _at_the_end(run: Rollout) -> Mapping[str, float | None]:
    last = run.common.times.size - 1
    velocity, acceleration = (run.pair(last, name) for name in ("velocity", "acceleration"))
    measures: dict[str, float | None] = {
        "velocity_error_end": velocity_error(velocity.model, velocity.truth),
        "energy_ratio": float(np.sum(fluctuations(velocity.model) ** 2) / np.sum(fluctuations(velocity.truth) ** 2)),
        "velocity_kl": pdf_divergence(velocity, EDGES["velocity"]),
        "velocity_kl_floor": sampling_floor(velocity, EDGES["velocity"]),
        "acceleration_kl": pdf_divergence(acceleration, EDGES["acceleration"]),
        "acceleration_kl_floor": sampling_floor(acceleration, EDGES["acceleration"]),
        **differences(*of_both(run)),
    }
    for name, both in drifts(run).items():
        measures |= {name: both["model"], f"{name}_floor": both["truth"]}
    if last in run.spectral():
        spectra = run.spectra_at(last)
        measures |= {"spectrum_error": spectra.error("model", run.filter_wavenumber),
                     "spectrum_error_floor": spectra.error("truth", run.filter_wavenumber)}
    if run.invariants is not None:
        invariants = last_invariants(run)
        measures |= {"qr_kl": invariants.divergence, "qr_kl_floor": invariants.floor}
    return measures
