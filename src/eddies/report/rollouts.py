"""The report sections on rollouts: figures of several variants side by side, and their numbers at the last common time
of model and true tracers."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from eddies.analysis import disorder
from eddies.report import rollout_figures as draw
from eddies.report.figures import Variant
from eddies.report.page import Section

# Description of each [simulation] method. The attributes of the rollout replace the names in braces.
METHODS = {
    "learned": "the model, terms {terms}",
    "none": "no force: every particle keeps its velocity",
    "eulerian": "Eulerian large-eddy simulation on {cells}³ cells, |kᵢ| ≤ {largest_wavenumber}, {fluid}, {equations} "
                "velocity, closure: {closure}, started from the {start}",
}
LABELS = {
    "method": "what moved the particles", "two_flows": "model and truth are forced differently",
    "broken": "model is not finite from (T)", "outside_training": "pairs outside the training range, largest share",
    "closure_iterations": "iterations of a solve for the resolved velocity, mean",
    "closure_most_iterations": "iterations of a solve, maximum",
    "closure_residual": "largest residual of a solve / rms velocity", "last_common_time": "last common time / T",
    "energy_ratio_no_force": "energy, model / truth, for particles without any force",
    "early_time": "early time / T (half a turnover, or the end if it is earlier)",
    "acceleration_rms_ratio": "rms of the acceleration, model / truth",
    "plane_difference": "relative difference of u_x in the last plane",
    "filter_wavenumber": "filter wavenumber k_d = π/d", "nearest_distance_kl": "KL nearest-neighbour distance",
    "band_energy_ratios": "energy of bands of wavenumbers, model / filtered flow",
    "seconds_per_step": "seconds of a step (median, without storing)",
    "storing_share": "share of the wall time that storing took"}
OF_FORCED = {"acceleration_rms": "rms of an acceleration component", "spectrum_error": "error of the mean spectrum",
             "true_energy": "energy of the true tracers over the same time", "average_from": "averages from (T)"}
REASONS = {
    **dict.fromkeys(("qr_kl", "qr_kl_floor"),
                    "it needs velocity gradients from the smoothing kernel, and there is no kernel.h5"),
    "seconds_per_step": "too few steps to time: the first two, and the first two after a restart, are left out"}
# Figures: name of the file, table that a variant needs for it, function, title, caption.
FIGURES: tuple[tuple[str, str, Callable[[Sequence[Variant]], Figure], str, str], ...] = (
    ("figure-4-velocity", "planes", draw.velocity_planes, "Velocity over time (the paper's Fig. 4)",
     "u_x in the plane z = π, of true tracers and models from {words}. Numbers in panels: normalised L2 difference "
     "from the truth in the plane."),
    ("figure-5-vorticity-energy", "planes", draw.vorticity_and_energy,
     "Vorticity and kinetic energy (the paper's Fig. 5)",
     "Plane z = π at the last common time, of true tracers and models from {words}. Numbers in panels: normalised L2 "
     "difference from the truth in the plane. Colours go with the square root of the value."),
    ("figure-6-pdfs", "errors", draw.particle_pdfs, "PDFs of velocity and acceleration (the paper's Fig. 6)",
     "All components, centred and divided by the truth's standard deviation at that time. Values beyond the axis count "
     "in the last bins."),
    ("figure-7-invariants", "invariants", draw.invariant_planes,
     "Invariants Q and R of the velocity gradient (the paper's Fig. 7)",
     "Joint PDF at the last common time, in steps of half a decade. Orange: Vieillefosse line. Units: the truth's "
     "⟨Q_w⟩ = ⟨W:W⟩/2. Bottom: mean motion over all frames until then."),
    ("figure-8-spectra", "spectra", draw.energy_spectra, "Energy spectra over time (the paper's Fig. 8)",
     "Spectra of the solenoidal modes that a least-squares fit finds in the velocities of the models' particles and of "
     "the true tracers. Dotted and dashed: the DNS itself. Bottom: ratios to the true tracers. k_d = π/d is the filter "
     "wavenumber."),
    ("figure-9-errors", "errors", draw.errors_over_time, "Rollout over time",
     "Dashed: particles that keep the true velocity of the first frame. Dotted: an error as large as the velocity "
     "itself."),
    ("lagrangian", "paths_model", draw.path_statistics, "Lagrangian statistics",
     "A, C: autocorrelations of velocity and acceleration. B, E: second moment and flatness (3 if Gaussian) of "
     "velocity increments over a lag. D: variance of an acceleration component. F: mean square change of the "
     "separation of nearest neighbours / its first mean square. G, H: tetrads of a particle and its three nearest "
     "neighbours. G: R² / its first value. H: eigenvalues of the moments / R² (1/3 each for a regular tetrahedron)."),
    ("particle-disorder", "distances", draw.particle_disorder, "Disorder of the particles",
     "A: distance to the nearest neighbour at the last common time. B: variance of the number of particles in cells of "
     f"{disorder.CELL:g} mean spacings, 1 for random points. A value above that of the truth means that particles "
     "cluster."))


def moved_by(attributes: Mapping[str, float | str]) -> str:
    """Return a description of what moved the particles, from the attributes of a rollout."""
    name = str(attributes["method"])
    return METHODS.get(name, name).format_map({"start": "flow", **attributes})  # older files have no start


def rollout_numbers(found: Mapping[str, Any], seconds: Mapping[str, float]) -> dict[str, Any]:
    """Return the numbers of a rollout for metrics.json: those of its measures `found`, and its costs. `seconds` are the
    wall times of the stages in its directory."""
    attributes, numbers = found["attributes"], dict(found["rollout"])
    numbers |= {"method": moved_by(attributes), "integrator": attributes["integrator"],
                **{key: attributes.get(key) for key in ("seconds_per_step", "particles", "ranks")}}
    if found["not_compared"]:
        numbers |= dict.fromkeys(("energy_ratio", "velocity_error", "spectrum_error", "velocity_kl", "acceleration_kl",
                                  "qr_kl"))
    if "evaluations" in attributes and attributes["turnovers"] > 0:
        numbers |= {"storing_share": attributes.get("storing_share"),
                    "evaluations_per_turnover": attributes["evaluations"] / attributes["turnovers"]}
    return numbers | {"stage_seconds": dict(seconds) or None}


def section(variants: Sequence[Variant], numbers: Sequence[Mapping[str, Any]], others: int) -> Section:
    """Return the section with the paper's Figs. 4 to 9, Lagrangian statistics, and the disorder of the particles.

    variants: with the numbers and tables of measures.h5. numbers: `rollout_numbers` of each variant. others: the number
    of further variants, which are not shown.
    """
    text = (f"T = {draw.turnover_of(variants):.3g} is the eddy turnover time. Numbers are those of the last time that "
            "a model and the true tracers have in common.")
    if others:
        text += f" {others} more variants are in metrics.json; `--variant` chooses those that are shown."
    notices: dict[str, list[str]] = {}
    for each in variants:
        for notice in _notices(each.numbers):
            notices.setdefault(notice, []).append(each.label)
    found = Section("rollouts", "Rollouts against the truth", text, labels=LABELS, reasons=REASONS,
                    columns={each.label: own for each, own in zip(variants, numbers)},
                    notices=[f"{', '.join(labels)}: {notice}" for notice, labels in notices.items()])
    for name, table, function, title, caption in FIGURES:
        if chosen := with_same_truth([each for each in variants if table in each.tables]):
            found.add_figure(name, title, lambda function=function, chosen=chosen: function(chosen),
                             caption.format(words=variants[0].numbers["reconstructed_by"]))
    return found


def with_same_truth(variants: Sequence[Variant]) -> list[Variant]:
    """Return the variants whose truth is that of the first one, at the same first time."""
    truths = [(each.numbers["truth"], each.numbers["attributes"]["start_time"]) for each in variants]
    return [each for each, truth in zip(variants, truths) if truth == truths[0]]


def _notices(found: Mapping[str, Any]) -> Iterator[str]:
    """Yield sentences on a rollout that needs care. `found` are the numbers of its measures."""
    numbers, attributes = found["rollout"], found["attributes"]
    if found["not_compared"]:
        yield f"The rollout is not compared with the truth: {found['not_compared']}. Its status: {numbers['status']}."
    elif numbers["status"] != "complete":
        yield f"The rollout {numbers['status']} (last frame at {numbers['turnovers']:.3g} T)."
    model, truth = (float(attributes.get(name, 0.0)) for name in ("injection_rate", "truth_injection_rate"))
    if model != truth:
        model, truth = (f"forced with a power of {power:.3g} per mass" if power > 0 else "not forced"
                        for power in (model, truth))
        yield (f"The model is {model}, and the flow of the true tracers is {truth}. They are two different flows, and "
               "this comparison says little about the model.")
    if "broken" in numbers:
        yield f"The model is not finite from {numbers['broken']:.3g} T on. Only earlier frames are used."
    elif numbers.get("last_common_time", np.inf) < numbers["turnovers"] * (1 - 1e-9):
        yield (f"The true tracers end at {numbers['last_common_time']:.3g} T and the model at "
               f"{numbers['turnovers']:.3g} T. Later frames are not compared.")
    if numbers.get("closure_not_converged"):
        yield (f"{numbers['closure_not_converged']} solves for the resolved velocity did not converge. The largest "
               f"residual is {numbers['closure_residual']:.1e} of the rms velocity.")


def forced_section(variants: Sequence[Variant]) -> Section:
    """Return the section on forced rollouts: averages over the second half of their time, and those of the stationary
    state of the ground truth."""
    compared = [each for each in variants if each.numbers["forced"]]
    found = Section(
        "forced", "Forced rollouts beside the stationary state",
        "Averages over the second half of a rollout are compared with those of the filtered flow over its stationary "
        "state. Standard errors are those of blocks of a turnover or more, because closer frames are not independent "
        "samples. PDFs are compared with those of the true tracers at the start, each in units of its own standard "
        "deviation.", labels=OF_FORCED, columns={each.label: each.numbers["forced"] for each in compared},
        notices=[f"{each.label}: the rollout is not compared: the model has no finite frame." for each in variants
                 if not each.numbers["forced"]])
    if chosen := with_same_truth(compared):
        found.add_figure("forced", "Forced rollouts", lambda: draw.forced_rollouts(chosen),
                         "Band: standard deviation of the energy of the stationary flow in time. Dotted: k_d.")
    return found
