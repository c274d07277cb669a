"""The report section on a rollout: figures, and numbers at the last common time of model and true tracers."""

from collections.abc import Mapping

import numpy as np

from eddies.analysis import against_truth, disorder
from eddies.analysis.errors import normalized_l2
from eddies.analysis.lagrangian import differences, of_both
from eddies.analysis.pdfs import kl_divergence
from eddies.analysis.rollout import PLANES, Rollout
from eddies.measures import MEASURES
from eddies.report import rollout_figures
from eddies.report.page import Metric, Section

MAIN = ("turnovers", "energy_ratio", "velocity_error", "spectrum_error", "velocity_kl", "acceleration_kl",
        "qr_kl")
# Description of each [simulation] method. The attributes of the rollout replace the names in braces.
METHODS = {
    "learned": "the model, terms {terms}",
    "none": "no force: every particle keeps its velocity",
    "eulerian": "Eulerian large-eddy simulation on {cells}³ cells, |kᵢ| ≤ {largest_wavenumber}, {fluid}, {equations} "
                "velocity, closure: {closure}, started from the {start}",
}
WITHOUT_KERNEL = "it needs velocity gradients from the smoothing kernel, and there is no kernel.h5"


def moved_by(attributes: Mapping[str, float | str]) -> str:
    """Return a description of what moved the particles, from the attributes of a rollout."""
    name = str(attributes["method"])
    return METHODS.get(name, name).format_map({"start": "flow", **attributes})  # older files have no start


def section(run: Rollout, main: bool = True) -> Section:
    """Return the section with the paper's Figs. 4 to 9, Lagrangian statistics, and the disorder of the particles.

    If `main` is false, as on the page of a variant, the section has fewer figures, but still all numbers.
    """
    taken = "time_step" in run.attributes
    steps = f"time step {float(run.attributes['time_step']):.3g}" if taken else "no step was taken"
    method = moved_by(run.attributes)
    text = (f"Moved by: {method}. Integrator: {run.attributes['integrator']}, {steps}. "
            f"T = {run.turnover:.3g} is the eddy turnover time. ")
    if run.forced and len(set(run.powers)) == 1:
        text += f"Model and truth are both forced with a power of {run.powers[0]:.3g} per mass. "
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
        shown.notices.append(f"The rollout is not compared with the truth: {error}. Its status: {run.status}.")
        shown.metrics += [Metric(key, key.replace("_", " "), None, str(error)) for key in MAIN[1:]]
        return shown
    shown.text += (f"Numbers are those at t = {last / run.turnover:.3g} T, the last time that model and true tracers "
                   "have in common.")
    shown.notices += _notices(run, last)
    shown.metrics.append(Metric("last_common_time", "last common time / T", last / run.turnover))
    _add_particles(shown, run, main)
    if run.invariants is not None:
        _add_planes(shown, run, main)
        _add_invariants(shown, run, main)
    else:
        shown.metrics += [Metric(key, MEASURES[key], None, WITHOUT_KERNEL) for key in ("qr_kl", "qr_kl_floor")]
    _add_spectra(shown, run, main)
    _add_paths(shown, run, main)
    _add_disorder(shown, run, main)
    shown.illustrations.sort(key=lambda illustration: illustration.name)
    return shown


def _add_closure(shown: Section, solves: Mapping[str, np.ndarray]) -> None:
    """Add numbers on the solves for the resolved velocity.

    The mean leaves out the solve of the first frame, because it cannot start from the solution of an earlier solve.
    """
    count, failed = solves["solves"][1:].sum(), int(solves["not_converged"].sum())
    shown.metrics += [
        Metric("closure_iterations", "iterations of a solve for the resolved velocity, mean",
               float(solves["iterations"][1:].sum() / count) if count else None, "no step was taken"),
        Metric("closure_most_iterations", "iterations of a solve, maximum", int(solves["most_iterations"].max())),
        Metric("closure_residual", "largest residual of a solve / rms velocity", float(solves["residual"].max())),
        Metric("closure_not_converged", "solves that did not converge", failed),
    ]
    if failed:
        shown.notices.append(f"{failed} solves for the resolved velocity did not converge. The largest residual is "
                             f"{solves['residual'].max():.1e} of the rms velocity.")


def _notices(run: Rollout, last: float) -> list[str]:
    end, turnover = run.model.times[-1], run.turnover
    notices = []
    if run.powers[0] != run.powers[1]:
        model, truth = (f"forced with a power of {power:.3g} per mass" if power > 0 else "not forced"
                        for power in run.powers)
        notices.append(f"The model is {model}, and the flow of the true tracers is {truth}. They are two different "
                       "flows, and this comparison says little about the model." + (
                           " If the ground truth has a stationary state ([spin_up] stationary), the next section "
                           "compares the model with that state." if run.forced else ""))
    if run.status != "complete":
        notices.append(f"The rollout {run.status} (last frame at {end / turnover:.3g} T).")
    if np.isfinite(run.broken):
        notices.append(f"The model is not finite from {run.broken / turnover:.3g} T on. Only earlier frames are used.")
    elif end > last:
        notices.append(f"The true tracers end at {last / turnover:.3g} T and the model at {end / turnover:.3g} T. "
                       "Later frames are not compared.")
    return notices


def _add_planes(shown: Section, run: Rollout, main: bool) -> None:
    shown_at = run.common.spread(PLANES)
    times = run.common.times[list(shown_at)] / run.turnover
    models, truths = zip(*(run.both(run.planes, index) for index in shown_at))
    model, truth = models[-1], truths[-1]
    shown.add_figure(
        "figure-4-velocity", "Velocity over time (the paper's Fig. 4)",
        rollout_figures.velocity_planes({"true tracers": truths, "model": models}, times),
        f"u_x in the plane z = π. Top: true tracers; bottom: model; both from {run.reconstructed_by}. "
        f"Relative difference in the last plane: {normalized_l2(model.velocity[0], truth.velocity[0]):.3f}.")
    if not main:
        return
    ratios = [quantity(model).mean() / quantity(truth).mean() for quantity in (
        lambda plane: plane.vorticity, rollout_figures.kinetic_energy)]
    shown.add_figure(
        "figure-5-vorticity-energy", "Vorticity and kinetic energy (the paper's Fig. 5)",
        rollout_figures.vorticity_and_energy({"true tracers": truth, "model": model}),
        f"Plane z = π at t = {times[-1]:.2f} T, both from {run.reconstructed_by}. Mean over the plane, "
        f"model / truth: vorticity {ratios[0]:.2f}, energy {ratios[1]:.2f}.")


def _add_invariants(shown: Section, run: Rollout, main: bool) -> None:
    """Add joint PDFs of the invariants Q and R at the last common time and, if `main` is true, the mean rates of Q and
    R."""
    statistics = against_truth.last_invariants(run)
    shown.metrics += [
        Metric("qr_kl", "KL divergence of the Q–R joint PDF", statistics.divergence),
        Metric("qr_kl_floor", "KL divergence of the Q–R joint PDF between two samples of the truth of equal size",
               statistics.floor)]
    flows = against_truth.conditional_flows(run, statistics.bins) if main else None
    shown.add_figure(
        "figure-7-invariants", "Invariants Q and R of the velocity gradient (the paper's Fig. 7)",
        rollout_figures.invariant_plane(statistics, flows),
        f"Joint PDF at t = {run.common.times[-1] / run.turnover:.2f} T, in steps of half a decade. KL divergence: "
        f"{statistics.divergence:.2g}; between samples of the truth: {statistics.floor:.2g}. Orange: Vieillefosse "
        "line. Units: the truth's ⟨Q_w⟩ = ⟨W:W⟩/2."
        + (" Bottom: mean motion over all frames until then." if flows else ""))


def _add_particles(shown: Section, run: Rollout, main: bool) -> None:
    errors, common = against_truth.error_series(run), run.common
    final = {name: float(values[-1]) for name, values in errors.items()}
    model = against_truth.particle_series(run.model, np.arange(run.model.times.size))
    truth = against_truth.particle_series(run.truth, common.truth)
    ratio = float(model["energy"][common.model[-1]] / truth["energy"][-1])
    # The early time is half a turnover, or the last common time if that is earlier.
    early = min(run.turnover / 2, float(errors["time"][-1]))
    early_error, early_without = (float(np.interp(early, errors["time"], errors[name]))
                                  for name in ("velocity_error", "no_force"))
    times = common.spread(3) if main else [-1]
    pairs = {column: [run.pair(index, column) for index in times] for column in against_truth.EDGES}
    floors = {column: against_truth.sampling_floor(pairs[column][-1], edges)
              for column, edges in against_truth.EDGES.items()}
    accelerations = pairs["acceleration"][-1]
    shown.metrics += [
        Metric("energy_ratio", "kinetic energy of the particles at the end, model / truth", ratio),
        Metric("energy_ratio_no_force", "the same ratio for particles without any force",
               float(truth["energy"][0] / truth["energy"][-1])),
        Metric("velocity_error", "velocity error by particle at the end (normalised L2)", final["velocity_error"]),
        Metric("early_time", "early time / T (half a turnover, or the end if it is earlier)", early / run.turnover),
        Metric("early_velocity_error", "velocity error by particle at the early time", early_error),
        Metric("early_velocity_error_no_force", "the same error for particles without any force", early_without),
        Metric("velocity_kl", "KL divergence of the velocity PDF at the end", final["velocity_kl"]),
        Metric("acceleration_kl", "KL divergence of the acceleration PDF at the end", final["acceleration_kl"]),
        *(Metric(f"{column}_kl_floor", f"KL divergence of the {column} PDF between two samples of the truth of equal "
                 "size", floor) for column, floor in floors.items()),
        Metric("acceleration_rms_ratio", "rms of the acceleration, model / truth",
               float(np.std(accelerations.model) / np.std(accelerations.truth))),
    ]
    shown.add_figure(
        "figure-6-pdfs", "PDFs of velocity and acceleration (the paper's Fig. 6)",
        rollout_figures.particle_pdfs(pairs, run.turnover),
        "All components, centred and divided by the truth's standard deviation at that time. Values beyond the axis "
        f"count in the last bins. At the last time the KL divergence is {final['velocity_kl']:.2g} (velocity) and "
        f"{final['acceleration_kl']:.2g} (acceleration); between samples of the truth it is {floors['velocity']:.2g} "
        f"and {floors['acceleration']:.2g}.")
    shown.add_figure(
        "figure-9-errors", "Rollout over time",
        rollout_figures.errors_over_time(model, truth, errors, run.turnover),
        f"At the last common time the model has {ratio:.3f} of the truth's energy and a velocity error of "
        f"{final['velocity_error']:.3f}. Dashed: particles without any force, error {errors['no_force'][-1]:.3f}. "
        "Dotted: an error as large as the velocity itself.")


def _add_spectra(shown: Section, run: Rollout, main: bool) -> None:
    """Add spectra. Their numbers are those of the last common time at which the spectrum of the flow is stored."""
    cutoff, series = run.filter_wavenumber, [run.spectra_at(index) for index in run.shown_spectra(main)]
    last = series[-1]
    errors = {name: last.error(name, cutoff) for name in ("model", "truth")}
    shown.metrics += [
        Metric("filter_wavenumber", "filter wavenumber k_d = π/d", cutoff),
        Metric("spectrum_error", "spectrum error, rms of ln(E/E_filtered) over 1 ≤ k ≤ k_d", errors["model"]),
        Metric("spectrum_error_floor", "spectrum error of the true tracers", errors["truth"]),
        Metric("band_energy_ratios", "energy of bands of wavenumbers, model / filtered flow",
               last.bands("model", cutoff)),
        Metric("band_energy_ratios_floor", "the same ratios for the true tracers", last.bands("truth", cutoff)),
    ]
    shown.add_figure(
        "figure-8-spectra", "Energy spectra over time (the paper's Fig. 8)",
        rollout_figures.energy_spectra(series, run.flow, run.start_time, run.turnover, cutoff),
        "Spectra of the solenoidal modes that a least-squares fit finds in the velocities of the model's particles and "
        "of the true tracers. Black and grey: the DNS itself. Rms of ln(E/E_filtered) at "
        f"t = {last.time / run.turnover:.2f} T up to k_d = π/d = {cutoff:.3g}: model {errors['model']:.3f}, true "
        f"tracers {errors['truth']:.3f}.")


def _add_paths(shown: Section, run: Rollout, main: bool) -> None:
    """Add Lagrangian statistics over all common frames."""
    model, truth = of_both(run)
    errors = differences(model, truth)
    shown.metrics += [Metric(key, MEASURES[key], value, "it needs several frames") for key, value in errors.items()]
    if not main:
        return
    shown.add_figure(
        "lagrangian", "Lagrangian statistics", rollout_figures.path_statistics(model, truth, run.turnover),
        f"Over {truth.times[-1] / run.turnover:.2f} T. A, C: autocorrelations of velocity and acceleration. B, E: "
        "second moment and flatness (3 if Gaussian) of velocity increments over a lag. D: variance of an acceleration "
        "component. F: mean square change of the separation of nearest neighbours / its first mean square. G, H: "
        "tetrads of a particle and its three nearest neighbours. G: R² / its first value. H: eigenvalues of the "
        "moments / R² (1/3 each for a regular tetrahedron). Rms of ln(model / truth): "
        + ", ".join(f"{name} {errors[key]:.2g}" for name, key in (
            ("flatness", "flatness_error"), ("pairs", "pair_dispersion_error"), ("tetrads", "tetrad_size_error"),
            ("shape of tetrads", "tetrad_shape_error"))) + ".")


def _add_disorder(shown: Section, run: Rollout, main: bool) -> None:
    """Add nearest-neighbour distances at the last common time and, over time, the variance of particle counts.

    The time ends before the first frame of the model that is not finite.
    """
    both = {"model": run.model, "truth": run.truth}
    position = run.pair(-1, "position")
    distances = {name: disorder.distance_probabilities(getattr(position, name), run.length) for name in both}
    divergence, drift = kl_divergence(distances["truth"], distances["model"]), disorder.drifts(run)
    shown.metrics += [
        Metric("nearest_distance_kl", "KL divergence of the nearest-neighbour distance PDF", divergence),
        *(Metric(key, MEASURES[key], values) for key, values in drift.items()),
    ]
    if not main:
        return
    counts = {}
    for name, frames in both.items():
        finite = run.before_broken(name)
        counts[name] = frames.times[finite], [disorder.count_variance(frames.read(int(frame), "position"), run.length)
                                              for frame in finite]
    shown.add_figure(
        "particle-disorder", "Disorder of the particles",
        rollout_figures.particle_disorder(distances, counts, run.turnover),
        f"A: distance to the nearest neighbour at t = {position.time / run.turnover:.2f} T; KL divergence "
        f"{divergence:.2g}. B: variance of the number of particles in cells of {disorder.CELL:g} mean spacings, 1 for "
        f"random points. At that time it is {drift['count_variance']['truth']:.2f} (true tracers) and "
        f"{drift['count_variance']['model']:.2f} (model). If the model's value is above the truth's, its particles "
        "cluster.")
