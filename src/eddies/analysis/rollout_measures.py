"""All numbers and small arrays by which a rollout is compared with its truth."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from eddies.analysis import against_truth, disorder
from eddies.analysis.accuracy import accuracy
from eddies.analysis.against_truth import EDGES
from eddies.analysis.errors import normalized_l2
from eddies.analysis.forced import forced_averages
from eddies.analysis.isotropic_turbulence import StationarySpan
from eddies.analysis.lagrangian import PathStatistics, differences, of_both
from eddies.analysis.pdfs import bin_probabilities, kl_divergence, standardized
from eddies.analysis.rollout import PLANES, SHOWN, Rollout
from eddies.analysis.velocity_gradients import ConditionalVelocity

Tables = dict[str, dict[str, np.ndarray]]
BOTH = "model", "truth"


def measures(run: Rollout, span: StationarySpan | None) -> tuple[dict[str, Any], Tables]:
    """Return the numbers and the tables of a rollout. `span` is the stationary state of the ground truth, or None.

    Numbers are those of the last time that model and true tracers have in common. The dict of numbers has the keys
    `rollout`; `accuracy`, the measures of variants; `forced`, averages of a forced rollout, if there is a stationary
    state; and `not_compared`, the reason why the rollout is not compared with the truth, or "".
    """
    numbers, tables = of_model(run), {}
    found: dict[str, Any] = {"rollout": numbers, "accuracy": accuracy(run), "not_compared": ""}
    if run.forced and span is not None and len(run.truth.times):
        found["forced"], tables = forced_averages(run, span)
    if len(run.before_broken("model")):
        tables["model"] = series(run, "model")
    try:
        last = float(run.common.times[-1])
    except ValueError as error:
        return found | {"not_compared": str(error)}, tables
    numbers["last_common_time"] = last / run.turnover
    tables["truth"] = series(run, "truth")
    for add in (_particles, _planes, _invariants, _spectra, _paths, _disorder):
        more, arrays = add(run)
        numbers |= more
        tables |= arrays
    return found, tables


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
    last = {column: run.pair(-1, column) for column in EDGES}
    accelerations = last["acceleration"]
    chosen = common.spread(SHOWN)
    pdfs: dict[str, np.ndarray] = {"time": common.times[chosen]}
    for column, edges in EDGES.items():
        pairs = [run.pair(index, column) for index in chosen]
        for of in BOTH:
            pdfs[f"{column}_{of}"] = np.array([bin_probabilities(standardized(getattr(pair, of), pair.truth), edges)
                                               for pair in pairs])
        pdfs[f"{column}_kl"] = errors[f"{column}_kl"][chosen]
    return {
        "energy_ratio": float(model[-1] / truth[-1]), "energy_ratio_no_force": float(truth[0] / truth[-1]),
        "velocity_error": float(errors["velocity_error"][-1]), "early_time": early / run.turnover,
        "early_velocity_error": early_error, "early_velocity_error_no_force": early_without,
        "velocity_kl": float(errors["velocity_kl"][-1]), "acceleration_kl": float(errors["acceleration_kl"][-1]),
        **{f"{column}_kl_floor": against_truth.sampling_floor(pair, EDGES[column]) for column, pair in last.items()},
        "acceleration_rms_ratio": float(np.std(accelerations.model) / np.std(accelerations.truth)),
    }, {"errors": errors, "pdfs": pdfs}


def _planes(run: Rollout) -> tuple[dict[str, Any], Tables]:
    """Return planes in single precision, at up to PLANES times."""
    if run.planes is None:
        return {}, {}
    chosen = run.common.spread(PLANES)
    columns: dict[str, list] = {f"{quantity}_{of}": [] for quantity in ("velocity", "vorticity") for of in BOTH}
    for index in chosen:
        for of, plane in zip(BOTH, run.both(run.planes, index)):
            columns[f"velocity_{of}"].append(plane.velocity)
            columns[f"vorticity_{of}"].append(plane.vorticity)
    model, truth = run.both(run.planes, int(chosen[-1]))
    return {"plane_difference": normalized_l2(model.velocity[0], truth.velocity[0])}, {
        "planes": {"time": run.common.times[chosen],
                   **{name: np.array(values, np.float32) for name, values in columns.items()}}}


def _invariants(run: Rollout) -> tuple[dict[str, Any], Tables]:
    """Return joint PDFs of the invariants Q and R at the last common time, and the mean rates of Q and R."""
    if run.invariants is None:
        return {"qr_kl": None, "qr_kl_floor": None}, {}
    found = against_truth.last_invariants(run)
    tables: Tables = {"invariants": {"second": found.bins.second, "third": found.bins.third, "model": found.model,
                                     "truth": found.truth}}
    if flows := against_truth.conditional_flows(run, found.bins):
        tables["invariant_rates"] = {"second": flows[0].bins.second, "third": flows[0].bins.third, **{
            f"{name}_{of}": getattr(flow, name) for of, flow in zip(BOTH, flows) for name in ConditionalVelocity.SUMS}}
    return {"qr_kl": found.divergence, "qr_kl_floor": found.floor}, tables


def _spectra(run: Rollout) -> tuple[dict[str, Any], Tables]:
    """Return spectra. Numbers are those of the last common time at which the spectrum of the flow is stored."""
    cutoff, shown = run.filter_wavenumber, [run.spectra_at(index) for index in run.shown_spectra()]
    last, times = shown[-1], np.array([at.time for at in shown])
    nearest = [int(np.argmin(np.abs(run.flow["time"] - (run.start_time + time)))) for time in times]
    tables = {"spectra": {"time": times, **{of: np.array([getattr(at, of) for at in shown]) for of in BOTH}},
              "flow_spectra": {"time": times, "wavenumber": run.flow["wavenumber"],
                               **{name: run.flow[name][nearest] for name in ("energy", "filtered")}}}
    return {"filter_wavenumber": cutoff, "spectrum_error": last.error("model", cutoff),
            "spectrum_error_floor": last.error("truth", cutoff), "band_energy_ratios": last.bands("model", cutoff),
            "band_energy_ratios_floor": last.bands("truth", cutoff)}, tables


def _paths(run: Rollout) -> tuple[dict[str, Any], Tables]:
    """Return Lagrangian statistics over all common frames."""
    both = of_both(run)
    return differences(*both), {f"paths_{of}": columns_of(paths) for of, paths in zip(BOTH, both)}


def columns_of(paths: PathStatistics) -> Mapping[str, np.ndarray]:
    return {each.name: np.asarray(getattr(paths, each.name)) for each in fields(paths)}


def _disorder(run: Rollout) -> tuple[dict[str, Any], Tables]:
    position = run.pair(-1, "position")
    distances = {of: disorder.distance_probabilities(getattr(position, of), run.length) for of in BOTH}
    return {"nearest_distance_kl": kl_divergence(distances["truth"], distances["model"]), **disorder.drifts(run)}, {
        "distances": distances}
