"""All numbers and small arrays by which a rollout is compared with its truth."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from eddies.analysis import against_truth, disorder
from eddies.analysis.against_truth import EDGES
from eddies.analysis.errors import band_ratios, fluctuations, normalized_l2, spectrum_error
from eddies.analysis.forced import forced_averages
from eddies.analysis.isotropic_turbulence import StationarySpan
from eddies.analysis.lagrangian import differences, of_both
from eddies.analysis.pdfs import bin_centres, bin_probabilities, kl_divergence, standardized
from eddies.analysis.rollout import Rollout
from eddies.measures import MEASURES

Tables = dict[str, dict[str, np.ndarray]]
BOTH = "model", "truth"
FEWEST = 8  # smallest number of particles in a cell of the Q-R plane whose mean motion is kept
OVER_LAGS = "structure", "flatness", "acceleration_correlation"


def measures(run: Rollout, span: StationarySpan | None) -> tuple[dict[str, Any], Tables]:
    """Return the numbers and the tables of a rollout. `span` is the stationary state of the ground truth, or None.

    Numbers are those of the last time that model and true tracers have in common. The dict of numbers has the keys
    `rollout`; `accuracy`, the measures of variants; `forced`, averages of a forced rollout, if there is a stationary
    state; and `not_compared`, the reason why the rollout is not compared with the truth, or "".
    """
    numbers, tables = of_model(run), {}
    found: dict[str, Any] = {"rollout": numbers, "not_compared": ""}
    if run.forced and span is not None and len(run.truth.times):
        found["forced"], tables = forced_averages(run, span)
    if len(run.before_broken("model")):
        tables["model"] = series(run, "model")
    try:
        last = float(run.common.times[-1])
    except ValueError as error:
        return found | {"accuracy": dict.fromkeys([*MEASURES, "end"]), "not_compared": str(error)}, tables
    numbers["last_common_time"] = last / run.turnover
    tables["truth"] = series(run, "truth")
    for add in (_particles, _planes, _invariants, _spectra, _paths, _disorder):
        more, arrays = add(run)
        numbers |= more
        tables |= arrays
    return found | {"accuracy": accuracy(run, numbers, tables["errors"])}, tables


def accuracy(run: Rollout, numbers: Mapping[str, Any], errors: Mapping[str, np.ndarray]) -> dict[str, float | None]:
    """Return the measures of a rollout by their keys in MEASURES, and the end of the comparison by the key `end`.

    The end is the last time that model and truth have in common, in units of the turnover time T. A measure is None if
    its data are missing, for example because the rollout or the truth ends too early. Velocity errors are normalised L2
    errors over all particles; they and the energy leave the mean velocity out. Those at the Kolmogorov time t_eta and
    at T/2 are interpolated linearly between frames. The acceleration error is that of the first common frame. The other
    measures are taken at the last common frame or, if they are Lagrangian statistics, over all common frames. These are
    None for a rollout that stops early or has a frame that is not finite, because such a rollout ends earlier than the
    others. They are taken from `numbers`, those of the rollout. `errors` is the table of `error_series`.
    """
    def at(time: float) -> float | None:
        times = errors["time"]
        return float(np.interp(time, times, errors["velocity_error"])) if times[0] <= time <= times[-1] else None

    measures: dict[str, float | None] = dict.fromkeys(MEASURES)
    if numbers["stable"]:
        pairs = {name: values for name, values in numbers.items() if name in ("momentum_drift", "density_drift",
                                                                              "count_variance")}
        known = {**numbers, "velocity_error_end": numbers["velocity_error"],
                 **{name: values["model"] for name, values in pairs.items()},
                 **{f"{name}_floor": values["truth"] for name, values in pairs.items()}}
        velocity, last = run.pair(-1, "velocity"), len(run.common.times) - 1
        known["energy_ratio"] = float(np.sum(fluctuations(velocity.model) ** 2)
                                      / np.sum(fluctuations(velocity.truth) ** 2))
        if last not in run.spectral():
            known |= dict.fromkeys(("spectrum_error", "spectrum_error_floor"))
        measures = {key: known.get(key) for key in MEASURES}
    start = run.pair(0, "acceleration")
    return measures | {"velocity_error_early": at(run.reference["kolmogorov_time"]),
                       "velocity_error_half": at(run.turnover / 2),
                       "acceleration_error": normalized_l2(start.model, start.truth),
                       "end": float(run.common.times[-1]) / run.turnover}


def of_model(run: Rollout) -> dict[str, Any]:
    """Return the numbers that need no truth.

    The mean number of iterations leaves out the solve of the first frame, because it cannot start from the solution of
    an earlier solve.
    """
    found: dict[str, Any] = {"status": run.status, "stable": run.status == "complete" and not np.isfinite(run.broken),
                             "turnovers": float(run.attributes["turnovers"])}
    if run.powers[0] != run.powers[1]:
        found["two_flows"] = True
    if np.isfinite(run.broken):
        found["broken"] = run.broken / run.turnover
    if run.outside_training is not None:
        found["outside_training"] = float(run.outside_training.max())
    if run.closure is not None:
        solves = run.closure
        count = solves["solves"][1:].sum()
        found |= {"closure_iterations": float(solves["iterations"][1:].sum() / count) if count else None,
                  "closure_most_iterations": _integer(solves["most_iterations"].max()),
                  "closure_residual": float(solves["residual"].max()),
                  "closure_not_converged": _integer(solves["not_converged"].sum())}
    return found


def _integer(value: float) -> int | None:
    """Return an integer, or None for a value that is not finite, as in a damaged table."""
    return int(value) if np.isfinite(value) else None


def series(run: Rollout, of: str) -> dict[str, np.ndarray]:
    """Return time series of "model" or "truth" before `run.broken`: those of `particle_series` and `count_variance`."""
    particles, frames = getattr(run, of), run.before_broken(of)
    counts = [disorder.count_variance(particles.read(int(frame), "position"), run.length) for frame in frames]
    return {**against_truth.particle_series(particles, frames), "count_variance": np.array(counts)}


def _particles(run: Rollout) -> tuple[dict[str, Any], Tables]:
    errors, common = against_truth.error_series(run), run.common
    model, truth = (np.array([against_truth.mean_energy(frames, frame) for frame in (rows[0], rows[-1])])
                    for frames, rows in ((run.model, common.model), (run.truth, common.truth)))
    # The early time is half a turnover, or the last common time if that is earlier.
    early = min(run.turnover / 2, float(errors["time"][-1]))
    early_error, early_without = (float(np.interp(early, errors["time"], errors[name]))
                                  for name in ("velocity_error", "no_force"))
    numbers = {"energy_ratio": float(model[-1] / truth[-1]), "energy_ratio_no_force": float(truth[0] / truth[-1]),
               "velocity_error": float(errors["velocity_error"][-1]), "early_time": early / run.turnover,
               "early_velocity_error": early_error, "early_velocity_error_no_force": early_without}
    chosen = run.shown(np.arange(len(common.times)))
    tables = {"errors": errors}
    for column, edges in EDGES.items():
        pairs = [run.pair(index, column) for index in chosen]
        tables[f"{column}_pdfs"] = {"time": common.times[chosen], **{of: np.array([
            bin_probabilities(standardized(getattr(pair, of), pair.truth), edges) for pair in pairs]) for of in BOTH}}
        numbers |= {f"{column}_kl": float(errors[f"{column}_kl"][-1]),
                    f"{column}_kl_floor": against_truth.sampling_floor(pairs[-1], edges)}
    return numbers | {"acceleration_rms_ratio": float(np.std(pairs[-1].model) / np.std(pairs[-1].truth))}, tables


def _planes(run: Rollout) -> tuple[dict[str, Any], Tables]:
    """Return u_x, vorticity magnitude and kinetic energy in planes, single precision, at the times of the figures."""
    if run.planes is None:
        return {}, {}
    chosen = run.shown(np.arange(len(run.common.times)))
    planes: dict[str, list[np.ndarray]] = {}
    for index in chosen:
        both = run.both(run.planes, index)
        for of, (velocity, vorticity) in zip(BOTH, both):
            for name, values in (("u_x", velocity[0]), ("vorticity", vorticity),
                                 ("energy", np.sum(velocity**2, axis=0) / 2)):
                planes.setdefault(f"{name}_{of}", []).append(values)
    return {"plane_difference": normalized_l2(*(velocity[0] for velocity, _ in both))}, {
        "planes": {"time": run.common.times[chosen],
                   **{name: np.array(values, np.float32) for name, values in planes.items()}}}


def _invariants(run: Rollout) -> tuple[dict[str, Any], Tables]:
    """Return joint PDFs of the invariants Q and R at the last common time, and the mean rates of Q and R in cells with
    at least FEWEST particles. The axes have the centres of the cells."""
    if run.invariants is None:
        return {"qr_kl": None, "qr_kl_floor": None}, {}
    found = against_truth.last_invariants(run)
    tables: Tables = {"invariants": {"second": bin_centres(found.bins.second), "third": bin_centres(found.bins.third),
                                     **{of: found.bins.density(getattr(found, of)) for of in BOTH}}}
    if flows := against_truth.conditional_flows(run, found.bins):
        bins = flows[0].bins
        tables["invariant_rates"] = {"second": bin_centres(bins.second), "third": bin_centres(bins.third), **{
            f"{name}_rate_{of}": rate for of, flow in zip(BOTH, flows)
            for name, rate in zip(("second", "third"), flow.mean(FEWEST))}}
    return {"qr_kl": found.divergence, "qr_kl_floor": found.floor}, tables


def _spectra(run: Rollout) -> tuple[dict[str, Any], Tables]:
    """Return spectra. Numbers are those of the last common time at which the spectrum of the flow is stored."""
    cutoff, shown = run.filter_wavenumber, run.shown_spectra()
    found, times = [run.spectra_at(index) for index in shown], run.common.times[shown]
    numbers: dict[str, Any] = {"filter_wavenumber": cutoff}
    *both, filtered = found[-1]
    for floor, energy in zip(("", "_floor"), both):
        numbers |= {f"spectrum_error{floor}": spectrum_error(energy, filtered, cutoff),
                    f"band_energy_ratios{floor}": band_ratios(energy, filtered, cutoff)}
    rows = [run.flow_row(index) for index in shown]
    return numbers, {
        "spectra": {"time": times, **{f"energy_{of}": np.array(energy) for of, energy in zip(BOTH, zip(*found))}},
        "flow_spectra": {"time": times, "wavenumber": run.flow["wavenumber"], "energy_flow": run.flow["energy"][rows],
                         "energy_filtered": run.flow["filtered"][rows]}}


def _paths(run: Rollout) -> tuple[dict[str, Any], Tables]:
    """Return Lagrangian statistics over all common frames."""
    both, tables = of_both(run), {}
    for of, paths in zip(BOTH, both):
        columns = dict(vars(paths))
        tables[f"increments_{of}"] = {"lag": columns.pop("lags"), **{name: columns.pop(name) for name in OVER_LAGS}}
        tables[f"paths_{of}"] = {"time": columns.pop("times"), **columns}
    return differences(*both), tables


def _disorder(run: Rollout) -> tuple[dict[str, Any], Tables]:
    position = run.pair(-1, "position")
    distances = {of: disorder.distance_probabilities(getattr(position, of), run.length) for of in BOTH}
    return {"nearest_distance_kl": kl_divergence(distances["truth"], distances["model"]), **disorder.drifts(run)}, {
        "distances": distances}
