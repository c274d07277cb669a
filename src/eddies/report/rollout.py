"""The rollout's part of the report: its figures, and the numbers at the last common time with the truth."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from eddies.analysis import against_truth
from eddies.analysis.against_truth import CommonFrames, Frames, Pair, ParticleFrames
from eddies.analysis.errors import normalized_l2
from eddies.analysis.path_statistics import of_both
from eddies.analysis.rollout_spectra import RolloutSpectra
from eddies.analysis.spectra import vorticity
from eddies.report import disorder, lagrangian, rollout_figures, spectra
from eddies.report.page import Metric, Section
from eddies.report.statistics import invariant_plane, particle_pdfs

MAIN = ("turnovers", "energy_ratio", "velocity_error", "spectrum_error", "velocity_kl", "acceleration_kl",
        "qr_kl")
# What moved the particles, by [simulation] method, from the attributes of the rollout.
METHODS = {
    "learned": "the model, terms {terms}",
    "none": "no force: every particle keeps its velocity",
    "eulerian": "Eulerian large-eddy simulation on {cells}³ cells, |kᵢ| ≤ {largest_wavenumber}, {fluid}, {equations} "
                "velocity, closure: {closure}",
}
WITHOUT_KERNEL = "measured through the smoothing kernel, and the scene has none"
TRUTH_NAMES = {"filtered": "filtered DNS", "truth": "true tracers"}


@dataclass(frozen=True)
class Rollout:
    """A rollout as stored, with what it is compared with.

    attributes: of the group `rollout`; model, truth: trajectories; spectra: those stored with it; fields: the series
    "model", "truth" and "filtered", or None where there was no kernel to make them; length: box edge; filter_width: of
    the ground truth, or None;
    outside_training: share of the pairs outside the training range, (frames,), where it was counted;
    closure: columns over the frames on the solves for the resolved velocity, where there were any.
    """

    attributes: Mapping[str, float | str]
    model: ParticleFrames
    truth: ParticleFrames
    spectra: RolloutSpectra
    fields: Mapping[str, Frames] | None
    length: float
    filter_width: float | None
    outside_training: np.ndarray | None = None
    closure: Mapping[str, np.ndarray] | None = None

    @property
    def turnover(self) -> float:
        """Eddy turnover time T, the unit of time in the figures."""
        return float(self.attributes["eddy_turnover_time"])

    @property
    def filter_wavenumber(self) -> float | None:
        """k_d = pi / d, or None where the filter width is not known."""
        return None if self.filter_width is None else np.pi / self.filter_width

    @property
    def forced(self) -> bool:
        """Whether its large scales were forced."""
        return self.powers[0] > 0

    @property
    def powers(self) -> tuple[float, float]:
        """With which its large scales were forced and those of the true tracers, a mass."""
        model, truth = (float(self.attributes.get(name, 0.0)) for name in ("injection_rate", "truth_injection_rate"))
        return model, truth

    @property
    def method(self) -> str:
        """What moved the particles, in words."""
        name = str(self.attributes["method"])
        return METHODS.get(name, name).format_map(self.attributes)

    @property
    def status(self) -> str:
        """How it ended: "complete", or "stopped: reason"."""
        return str(self.attributes["status"])


def section(run: Rollout) -> Section:
    """The rollout: figures 4 to 9 and Lagrangian statistics; `run` is read frame by frame."""
    broken = against_truth.first_broken_time(run.model)
    steps = f"time step {float(run.attributes['time_step']):.3g}" if "time_step" in run.attributes else "without a step"
    text = (f"Moved by: {run.method}; integrator {run.attributes['integrator']}, {steps}. "
            f"T = {run.turnover:.3g} is the eddy turnover time. ")
    if run.forced and len(set(run.powers)) == 1:
        text += f"Model and truth are forced alike, with a power of {run.powers[0]:.3g} a mass. "
    shown = Section("rollout", "Rollout against the truth", text, main=MAIN, metrics=[
        Metric("method", "what moved the particles", run.method),
        Metric("status", "status", run.status),
        Metric("stable", "stable to the end", run.status == "complete" and not np.isfinite(broken)),
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
        common = CommonFrames.of(run.model, run.truth, broken)
    except ValueError as error:
        shown.notices.append(f"The rollout: {run.status}. It is not compared: {error}.")
        shown.metrics += [Metric(key, key.replace("_", " "), None, str(error)) for key in MAIN[1:]]
        return shown
    last = float(common.times[-1])
    shown.text += f"Numbers: at the last common time of model and true tracers, {last / run.turnover:.3g} T."
    shown.notices += _notices(run, last, broken)
    shown.metrics.append(Metric("last_common_time", "last common time / T", last / run.turnover))
    _add_particles(shown, run, common)
    if run.fields is not None:
        _add_planes(shown, run, run.fields, last)
        _add_invariants(shown, run, common)
    else:
        shown.metrics += [Metric(key, key.replace("_", " "), None, WITHOUT_KERNEL) for key in ("qr_kl", "qr_kl_floor")]
    spectra.add(shown, run.spectra, _just_after(last), run.turnover, run.filter_wavenumber)
    lagrangian.add(shown, *of_both(run.model, run.truth, common, run.length), run.turnover)
    found = disorder.measure({"model": run.model, "truth": run.truth}, run.fields, common, run.length, broken,
                             run.filter_wavenumber)
    disorder.add(shown, found, run.turnover)
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


def _notices(run: Rollout, last: float, broken: float) -> list[str]:
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
    if np.isfinite(broken):
        notices.append(f"The model is not finite from {broken / turnover:.3g} T on: earlier frames count.")
    elif end > last + 1e-6:
        notices.append(f"The true tracers end at {last / turnover:.3g} T and the model at "
                       f"{end / turnover:.3g} T: what comes after is not compared.")
    return notices


def _add_planes(shown: Section, run: Rollout, fields: Mapping[str, Frames], last: float) -> None:
    name = "filtered" if fields["filtered"].times.size else "truth"
    model, truth = fields["model"], fields[name]
    common = CommonFrames.of(model, truth, _just_after(last))
    planes = [_plane_of_first_component(model, truth, common, index) for index in common.spread(4)]
    shown.add_figure(
        "figure-4-velocity", "Velocity over time (the paper's Fig. 4)",
        rollout_figures.velocity_planes(planes, run.turnover, TRUTH_NAMES[name]),
        f"u_x in the plane z = π: {TRUTH_NAMES[name]} above, the model through the learned kernel below. "
        f"Relative difference in the last plane: {normalized_l2(planes[-1].model, planes[-1].truth):.3f}.")
    at = against_truth.particle_pair(model, truth, common, common.times.size - 1, "velocity")
    rotation = Pair(at.time, _magnitude(vorticity(at.model)), _magnitude(vorticity(at.truth)))
    energy = Pair(at.time, _magnitude(at.model) ** 2 / 2, _magnitude(at.truth) ** 2 / 2)
    ratios = [pair.model.mean() / pair.truth.mean() for pair in (rotation, energy)]
    shown.add_figure(
        "figure-5-vorticity-energy", "Vorticity and kinetic energy (the paper's Fig. 5)",
        rollout_figures.vorticity_and_energy(rotation, energy, TRUTH_NAMES[name]),
        f"Plane z = π at t = {at.time / run.turnover:.2f} T. Mean over the plane, model / truth: "
        f"vorticity {ratios[0]:.2f}, energy {ratios[1]:.2f}.")


def _add_particles(shown: Section, run: Rollout, common: CommonFrames) -> None:
    errors = against_truth.error_series(run.model, run.truth, common)
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
    pairs = {column: [against_truth.particle_pair(run.model, run.truth, common, index, column)
                      for index in common.spread(3)] for column in against_truth.EDGES}
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
        particle_pdfs(pairs, run.turnover),
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


def _add_invariants(shown: Section, run: Rollout, common: CommonFrames) -> None:
    statistics = against_truth.invariant_statistics(run.model, run.truth, common)
    shown.metrics += [
        Metric("qr_kl", "KL divergence of the Q–R joint PDF", statistics.divergence),
        Metric("qr_kl_floor", "the same of two samples of the truth, as large as this", statistics.floor)]
    shown.add_figure(
        "figure-7-invariants", "Invariants Q and R of the velocity gradient (the paper's Fig. 7)",
        invariant_plane(statistics),
        f"Joint PDF at t = {common.times[-1] / run.turnover:.2f} T (isolines half a decade apart, smoothed "
        f"over one bin for drawing; KL {statistics.divergence:.2g} from raw bins, between samples of the truth "
        f"{statistics.floor:.2g}) and mean motion over all "
        "frames until then. Orange: Vieillefosse line. Both are in units of the truth's ⟨Q_w⟩ = ⟨W:W⟩/2.")


def _plane_of_first_component(model: Frames, truth: Frames, common: CommonFrames, index: int) -> Pair:
    """u_x [y, x] of both in the plane z = pi."""
    planes = []
    for series, frame in ((model, common.model[index]), (truth, common.truth[index])):
        middle = series.cells // 2
        planes.append(series.read(int(frame), "velocity", middle, middle + 1)[0, 0])
    return Pair(float(common.times[index]), *planes)


def _magnitude(field: np.ndarray) -> np.ndarray:
    """Magnitude of a vector field (3, n, n, n) in the plane z = pi."""
    return np.linalg.norm(field[:, field.shape[1] // 2], axis=0)


def _just_after(time: float) -> float:
    return time + 1e-6 * max(1.0, abs(time))
