"""The report section on the model: a-priori errors and PDFs (the paper's Fig. 3), training, learned coefficients."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eddies.analysis.pdfs import bin_edges, bin_probabilities, kl_divergence, standardized
from eddies.report.figures import (DNS, FOURTH, GUIDE, MODEL, SECOND, draw_pdfs, legend_below, letter, note, panels,
                                   styled)
from eddies.report.learning import curves
from eddies.report.page import Metric, Section, shown

Table = Mapping[str, np.ndarray]

ERRORS = (  # column of the table, label, colour, line style, marker
    ("acceleration_error", "model", MODEL, "-", "o"),
    ("true_density_acceleration_error", "model given the true density", FOURTH, "-", "s"),
    ("density_rate_error", "density rate of the model", SECOND, "-", "^"),
    ("pressure_gradient_error", "exact filtered pressure gradient", DNS, "--", None),
)
EDGES = bin_edges(8, 65)  # edges of the bins of the PDFs, in standard deviations of the truth
METRICS = {  # key in the report: column of the table, label
    "acceleration_error": ("acceleration_error", "acceleration error at the true state (a priori)"),
    "true_density_acceleration_error": (
        "true_density_acceleration_error", "acceleration error given the true density"),
    "density_rate_error": ("density_rate_error", "density rate error at the true state"),
    "filtered_pressure_gradient_error": (
        "pressure_gradient_error", "acceleration error of the exact filtered pressure gradient"),
}
TRAINING = {
    "training_seconds": "wall seconds of the training, without reading and testing",
    "training_steps": "optimiser steps of the training, by phase",
    "training_error": "validation error at the end of each phase",
}


def section(description: Mapping[str, Any], table: Table, acceleration: Table, density_rate: Table | None,
            history: Table | None, source: str | None = None, others: Sequence[str] = ()) -> Section:
    """Return the section. Its errors are those of the a-priori test at the last frame.

    description: that of model.h5. table: a-priori errors, (frames,). acceleration, density_rate: see `a_priori`.
    history: columns over the steps of the training; None if nothing was trained. source: path of the run that the
    weights and the history come from; None if it is this run. others: the ground truths that the model was trained on;
    empty if the ground truth of this run, or of the run `source`, is among them.
    """
    last = int(np.argmax(table["delay"]))
    at = {name: float(values[last]) for name, values in table.items()}
    terms = ", ".join(description["terms"])
    metrics = [Metric(key, label, at.get(column), f"not defined for the terms {terms} in this flow")
               for key, (column, label) in METRICS.items()]
    since, trained = "training window", ""
    if source is not None:
        since = "release of the tracers, or after the training window on the flow of the training"
    if others:
        whose = "this flow" if source is None else f"the flow of {source}, where its weights come from"
        trained = f" Trained on {', '.join(others)}, and not on {whose}."
        since = "release of the tracers" if source is None else since
    metrics.append(Metric("delay", f"time of these errors after the {since}", at["delay"]))
    metrics += [*training_metrics(description), *coefficient_metrics(description)]
    part = Section("model", "Model", f"Terms: {terms}.{trained} A-priori test: the model sees the true particles of a "
                   f"frame. Numbers are those of the last frame, {at['delay']:.3g} after the {since}.", metrics=metrics,
                   main=("acceleration_error", "filtered_pressure_gradient_error"))
    truth, predicted = acceleration["truth"], acceleration["predicted"]
    divergence = kl_divergence(bin_probabilities(standardized(truth), EDGES),
                               bin_probabilities(standardized(predicted, truth), EDGES))
    beside = "without a model: 1"
    if "pressure_gradient_error" in at:
        beside = f"exact filtered pressure gradient alone: {at['pressure_gradient_error']:.3f}; {beside}"
    part.add_figure(
        "figure-3-a-priori", "A-priori errors and PDFs (the paper's Fig. 3)",
        a_priori(table, acceleration, density_rate),
        f"Acceleration error at the last frame: {at['acceleration_error']:.3f} ({beside}). KL divergence of the "
        f"acceleration PDF: {divergence:.2g}. Grey: frames of the training window.")
    if history is not None:
        part.add_figure("model-training", "Training of the model", curves(history),
                        f"{int(history['step'][-1]) + 1} steps" + (f", in {source}." if source else "."))
    return part


def training_metrics(description: Mapping[str, Any]) -> list[Metric]:
    """Return the wall time and the steps of the training, and the validation error at the end of each phase."""
    if "training" not in description:
        return [Metric(key, label, None, "not stored with these weights") for key, label in TRAINING.items()]
    phases = description["training"]
    values = {"training_seconds": float(sum(phase["seconds"] for phase in phases)),
              "training_steps": {phase["phase"]: phase["steps"] for phase in phases} or None,
              "training_error": {phase["phase"]: phase["error"] for phase in phases} or None}
    return [Metric(key, label, values[key], "the model has nothing to learn") for key, label in TRAINING.items()]


def coefficient_metrics(description: Mapping[str, Any]) -> list[Metric]:
    """Return the learned coefficients that the terms of the model declare."""
    return [Metric(f"{term} {each['name']}", f"{term}, {each['name']}: {each['meaning']}",
                   {key: each[key] for key in ("learned", "value", "unit", "meaning")}, written=_written(each))
            for term, found in description.get("coefficients", {}).items() for each in found]


def _written(coefficient: Mapping[str, Any]) -> str:
    """Return the text of a coefficient: its value as learned and, unless its unit is 1, in the units of the flow."""
    learned, value = (", ".join(map(shown, found if isinstance(found, list) else [found]))
                      for found in (coefficient["learned"], coefficient["value"]))
    return learned if coefficient["unit"] == "1" else f"{learned}, that is {value} {coefficient['unit']}"


def source_metrics(mach: float | None, errors: Table, source_mach: float | None,
                   source_errors: Table) -> list[Metric]:
    """Return the turbulent Mach number M_t and the mean acceleration error, for this flow and for that of the training.

    mach, errors: M_t and the table of a-priori errors of this flow. source_mach, source_errors: those of the flow of
    the training. An M_t is None for an incompressible fluid. The means are over the frames after the training window.
    """
    def unseen(table: Table) -> float | None:
        chosen = table["acceleration_error"][table["delay"] > 0]
        return float(chosen.mean()) if len(chosen) else None

    unknown = "an incompressible fluid has none, or it was not stored with these weights"
    seen = "no error after the training window is stored; train the model with a [training] window below 1"
    return [Metric("mach_turbulent", "turbulent Mach number M_t", mach, unknown),
            Metric("source_mach_turbulent", "M_t of the flow that the model was trained on", source_mach, unknown),
            Metric("source_acceleration_error", "mean acceleration error in that flow, after the training window",
                   unseen(source_errors), seen),
            Metric("unseen_acceleration_error", "mean acceleration error in this flow", unseen(errors), seen)]


@styled
def a_priori(table: Table, acceleration: Table, density_rate: Table | None) -> Figure:
    """Draw errors over the delay after the training window, and PDFs of truth and prediction at the last frame.

    table: columns (frames,). acceleration: columns `truth` and `predicted`, each (m, 3). density_rate: the same two
    columns, each (m,); None for a model without a density rate.
    """
    figure, axes = panels(1, 2 if density_rate is None else 3, (3.6, 3.8), below=0.95)
    _errors_panel(axes[0, 0], table)
    for axis, sample, title, symbol in zip(axes[0, 1:], (acceleration, density_rate), ("Acceleration", "Density rate"),
                                           (r"$a$", r"$\dot\rho$")):
        draw_pdfs(axis, sample["truth"], sample["predicted"], EDGES)
        axis.set(title=f"{title} PDF", xlabel=f"{symbol} / standard deviation of the truth", ylabel="PDF")
        legend_below(axis, 3)
    letter(axes.flat)
    return figure


def _errors_panel(axis: Axes, table: Table) -> None:
    delay = table["delay"]
    seen = delay.min() < 0
    axis.axhline(1, color=GUIDE, linestyle=":", linewidth=1.2, label="no model")
    if seen:
        axis.axvspan(delay.min() - 0.03 * np.ptp(delay), 0, color="#eeeeee", zorder=0)
        note(axis, "training", (delay.min(), 1), ("data", "axes fraction"), (0, 0), va="top", fontsize=8)
    drawn = [each for each in ERRORS if each[0] in table]
    for column, label, colour, style, marker in drawn:
        axis.plot(delay, table[column], color=colour, linestyle=style, marker=marker, markersize=4, label=label)
    axis.set(title="A-priori error", ylabel="normalised L2 error",
             ylim=(0, max(1.1, *(1.05 * table[column].max() for column, *_ in drawn))),
             xlabel="delay after the training window" if seen else "time after the release of the tracers")
    legend_below(axis, 1)
