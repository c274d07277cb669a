"""The rollout's part of the report: its figures, and the numbers at the last common time with the truth."""

from collections.abc import Mapping

import numpy as np

from eddies.analysis import against_truth
from eddies.analysis.errors import normalized_l2
from eddies.analysis.lagrangian import of_both
from eddies.analysis.rollout import Pair, Reconstruction, Rollout
from eddies.report import disorder, lagrangian, rollout_figures, spectra
from eddies.report.page import Metric, Section

MAIN = ("turnovers", "energy_ratio", "velocity_error", "spectrum_error", "velocity_kl", "acceleration_kl",
        "qr_kl")
# What moved the particles, by [simulation] method, from the attributes of the rollout.
METHODS = {
    "learned": "the model, terms {terms}",
    "none": "no force: every particle keeps its velocity",
    "eulerian": "Eulerian large-eddy simulation on {cells}³ cells, |kᵢ| ≤ {largest_wavenumber}, {fluid}, {equations} "
                "velocity, closure: {closure}",
}
WITHOUT_KERNEL = "measured through the smoothing kernel, and there is no kernel.h5"
PLANES = 4  # of velocities over time


def moved_by(attributes: Mapping[str, float | str]) -> str:
    """What moved the particles, in words."""
    name = str(attributes["method"])
    return METHODS.get(name, name).format_map(attributes)


def section(run: Rollout) -> Section:
    """The rollout: figures 4 to 9 and Lagrangian statistics; `run` is read frame by frame."""
    steps = f"time step {float(run.attributes['time_step']):.3g}" if "time_step" in run.attributes else "without a step"
    method = moved_by(run.attributes)
    text = (f"Moved by: {method}; integrator {run.attributes['integrator']}, {steps}. "
            f"T = {run.turnover:.3g} is the eddy turnover time. ")
    if run.forced and len(set(run.powers)) == 1:
        text += f"Model and truth are forced alike, with a power of {run.powers[0]:.3g} a mass. "
    shown = Section("rollout", "Rollout against the truth", text, main=MAIN, metrics=[
        Metric("method", "what moved the particles", method),
        Metric("status", "status", run.status),
        Metric("stable", "stable to the end", run.status == "complete" and not np.isfinite(run.broken)),
        Metric("turnovers", "eddy turnovers of the rollout", float(run.attributes["turnovers"])),
    ])
    if run.powers[0] != run.powers[1]:
        shown.metrics.append(Metric("two_flows", "model and truth are forced differently", True))
    if run.outside_training is not None:
        shown.metrics.append(Metric("outside_training", "pairs outside the training range, largest share over time",
                                    float(run.outside_training.max())))
    if run.closure is not None:
        _add_closure(shown, run.closure)
    try:
        last = float(run.common.times[-1])
    except ValueError as error:
        shown.notices.append(f"The rollout: {run.status}. It is not compared: {error}.")
        shown.metrics += [Metric(key, key.replace("_", " "), None, str(error)) for key in MAIN[1:]]
        return shown
    shown.text += f"Numbers: at the last common time of model and true tracers, {last / run.turnover:.3g} T."
    shown.notices += _notices(run, last)
    shown.metrics.append(Metric("last_common_time", "last common time / T", last / run.turnover))
    _add_particles(shown, run)
    if run.reconstructions is not None:
        _add_planes(shown, run)
        _add_invariants(shown, run)
    else:
        shown.metrics += [Metric(key, key.replace("_", " "), None, WITHOUT_KERNEL) for key in ("qr_kl", "qr_kl_floor")]
    spectra.add(shown, run)
    lagrangian.add(shown, *of_both(run.model, run.truth, run.common, run.length), run.turnover)
    disorder.add(shown, run)
    shown.illustrations.sort(key=lambda illustration: illustration.name)
    return shown


def _add_closure(shown: Section, solves: Mapping[str, np.ndarray]) -> None:
    """What the solves for the resolved velocity took; those of the first frame, from nothing, are not in the mean."""
    count, failed = solves["solves"][1:].sum(), int(solves["not_converged"].sum())
    shown.metrics += [
        Metric("closure_iterations", "iterations of a solve for the resolved velocity, mean",
               float(solves["iterations"][1:].sum() / count) if count else None, "no step was taken"),
        Metric("closure_most_iterations", "iterations of a solve, most", int(solves["most_iterations"].max())),
        Metric("closure_residual", "largest residual of a solve, in the rms of the velocity",
               float(solves["residual"].max())),
        Metric("closure_not_converged", "solves that did not converge", failed),
    ]
    if failed:
        shown.notices.append(f"Solves for the resolved velocity that did not converge: {failed}; the worst left "
                             f"{solves['residual'].max():.1e} of the velocities' rms.")


def _notices(run: Rollout, last: float) -> list[str]:
    end, turnover = run.model.times[-1], run.turnover
    notices = []
    ours, theirs = run.powers
    if ours != theirs:
        told = [f"forced with a power of {power:.3g} a mass" if power > 0 else "not forced" for power in (ours, theirs)]
        notices.append(f"The model is {told[0]}, and the flow of the true tracers is {told[1]}: from the start on they "
                       "are two flows, and what is compared here says little of the model." + (
                           " Where the ground truth has a stationary state ([spin_up] stationary), the next section "
                           "compares the model with that." if run.forced else ""))
    if run.status != "complete":
        notices.append(f"The rollout {run.status} (last frame at {end / turnover:.3g} T).")
    if np.isfinite(run.broken):
        notices.append(f"The model is not finite from {run.broken / turnover:.3g} T on: earlier frames count.")
    elif end > last + 1e-6:
        notices.append(f"The true tracers end at {last / turnover:.3g} T and the model at "
                       f"{end / turnover:.3g} T: what comes after is not compared.")
    return notices


def _add_planes(shown: Section, run: Rollout) -> None:
    planes = []
    for index in run.common.spread(PLANES):
        model, truth = run.reconstructed(index)
        planes.append(Pair(float(run.common.times[index]), model.velocity[0], truth.velocity[0]))
    time = planes[-1].time
    shown.add_figure(
        "figure-4-velocity", "Velocity over time (the paper's Fig. 4)",
        rollout_figures.velocity_planes(planes, run.turnover),
        f"u_x in the plane z = π, of the true tracers above and of the model below, both by {run.reconstructed_by}. "
        f"Relative difference in the last plane: {normalized_l2(planes[-1].model, planes[-1].truth):.3f}.")
    rotation, energy = (Pair(time, *map(quantity, (model, truth))) for quantity in (_vorticity, _energy))
    ratios = [pair.model.mean() / pair.truth.mean() for pair in (rotation, energy)]
    shown.add_figure(
        "figure-5-vorticity-energy", "Vorticity and kinetic energy (the paper's Fig. 5)",
        rollout_figures.vorticity_and_energy(rotation, energy),
        f"Plane z = π at t = {time / run.turnover:.2f} T, both by {run.reconstructed_by}. Mean over the plane, "
        f"model / truth: vorticity {ratios[0]:.2f}, energy {ratios[1]:.2f}.")


def _vorticity(found: Reconstruction) -> np.ndarray:
    return found.vorticity


def _energy(found: Reconstruction) -> np.ndarray:
    return np.sum(found.velocity**2, axis=0) / 2


def _add_particles(shown: Section, run: Rollout) -> None:
    errors, common = against_truth.error_series(run), run.common
    final = {name: float(values[-1]) for name, values in errors.items()}
    model = against_truth.particle_series(run.model, np.arange(run.model.times.size))
    truth = against_truth.particle_series(run.truth, common.truth)
    ratio = float(model["energy"][common.model[-1]] / truth["energy"][-1])
    shown.metrics += [
        Metric("energy_ratio", "kinetic energy of the particles at the end, model / truth", ratio),
        Metric("energy_ratio_no_force", "the same of particles on which no force acts",
               float(truth["energy"][0] / truth["energy"][-1])),
        Metric("velocity_error", "velocity error by particle at the end (normalised L2)", final["velocity_error"]),
        *_early_errors(run.turnover, errors),
        Metric("velocity_kl", "KL divergence of the velocity PDF at the end", final["velocity_kl"]),
        Metric("acceleration_kl", "KL divergence of the acceleration PDF at the end", final["acceleration_kl"]),
    ]
    pairs = {column: [run.pair(index, column) for index in common.spread(3)] for column in against_truth.EDGES}
    floors = {column: against_truth.sampling_floor(pairs[column][-1], edges)
              for column, edges in against_truth.EDGES.items()}
    accelerations = pairs["acceleration"][-1]
    shown.metrics += [
        *(Metric(f"{column}_kl_floor", f"the same of two samples of the true {column}, as large as this", floor)
          for column, floor in floors.items()),
        Metric("acceleration_rms_ratio", "rms of the acceleration, model / truth",
               float(np.std(accelerations.model) / np.std(accelerations.truth))),
    ]
    shown.add_figure(
        "figure-6-pdfs", "PDFs of velocity and acceleration (the paper's Fig. 6)",
        rollout_figures.particle_pdfs(pairs, run.turnover),
        "All components, centred and divided by the truth's standard deviation at the time; values beyond "
        f"the axis count in its last bins. Last time: KL {final['velocity_kl']:.2g} (velocity), "
        f"{final['acceleration_kl']:.2g} (acceleration); between samples of the truth {floors['velocity']:.2g} and "
        f"{floors['acceleration']:.2g}.")
    shown.add_figure(
        "figure-9-errors", "Rollout over time",
        rollout_figures.errors_over_time(model, truth, errors, run.turnover),
        f"At the last common time the model has {ratio:.3f} of the truth's energy and a velocity error of "
        f"{final['velocity_error']:.3f}; particles on which no force acts (dashed) would have "
        f"{errors['no_force'][-1]:.3f} (dotted: 1, as large as the velocity itself).")


def _early_errors(turnover: float, errors: Mapping[str, np.ndarray]) -> list[Metric]:
    """Velocity errors of the model and of no force after half a turnover, or at the end if that is earlier."""
    time = min(turnover / 2, float(errors["time"][-1]))
    model, without = (float(np.interp(time, errors["time"], errors[name])) for name in ("velocity_error", "no_force"))
    return [Metric("early_time", "half a turnover, or the end if that is earlier / T", time / turnover),
            Metric("early_velocity_error", "velocity error by particle then", model),
            Metric("early_velocity_error_no_force", "the same of particles on which no force acts", without)]


def _add_invariants(shown: Section, run: Rollout) -> None:
    statistics = against_truth.last_invariants(run)
    shown.metrics += [
        Metric("qr_kl", "KL divergence of the Q–R joint PDF", statistics.divergence),
        Metric("qr_kl_floor", "the same of two samples of the truth, as large as this", statistics.floor)]
    shown.add_figure(
        "figure-7-invariants", "Invariants Q and R of the velocity gradient (the paper's Fig. 7)",
        rollout_figures.invariant_plane(statistics, against_truth.conditional_flows(run, statistics.bins)),
        f"Joint PDF at t = {run.common.times[-1] / run.turnover:.2f} T (isolines half a decade apart, smoothed "
        f"over one bin for drawing; KL {statistics.divergence:.2g} from raw bins, between samples of the truth "
        f"{statistics.floor:.2g}) and mean motion over all "
        "frames until then. Orange: Vieillefosse line. Both are in units of the truth's ⟨Q_w⟩ = ⟨W:W⟩/2.")
