"""The report section on models: a-priori errors and PDFs (the paper's Fig. 3), training, learned coefficients."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eddies.analysis.pdfs import bin_centres, bin_edges, gaussian, pdf, standardized
from eddies.report.figures import GUIDE, TRUTH, Look, legend_at_foot, letter, note, panels, styled
from eddies.report.learning import curves, curves_of_several
from eddies.report.page import Metric, Section, shown, side_by_side

Table = Mapping[str, np.ndarray]

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


@dataclass(frozen=True)
class TrainedModel:
    """A model in the report: its label, its colour and marker, and what its file holds.

    Parameters
    ----------
    description : that of model.h5.
    tables : the tables of model.h5 by name: `a_priori`, `acceleration_sample` and, if they exist,
        `density_rate_sample`, `history` and `source_a_priori`.
    source : provenance of the run that the weights and the history come from; None if it is this run.
    others : the ground truths that the model was trained on; empty if the ground truth of this run, or of the run
        `source`, is among them.
    mach : turbulent Mach number of this flow; None if it is incompressible.
    """

    label: str
    look: Look
    description: Mapping[str, Any]
    tables: Mapping[str, Table]
    source: Mapping[str, Any] | None = None
    others: Sequence[str] = ()
    mach: float | None = None

    @property
    def since(self) -> str:
        """The event from which the delay of the a-priori errors counts."""
        if self.source is not None:
            return "release of the tracers, or after the training window on the flow of the training"
        return "release of the tracers" if self.others else "training window"

    @property
    def at_the_end(self) -> dict[str, float]:
        """The a-priori errors at the last frame."""
        table = self.tables["a_priori"]
        last = int(np.argmax(table["delay"]))
        return {name: float(values[last]) for name, values in table.items()}

    @property
    def metrics(self) -> list[Metric]:
        """All numbers of the model."""
        terms, at = ", ".join(self.description["terms"]), self.at_the_end
        found = [Metric("terms", "terms", terms)]
        found += [Metric(key, label, at.get(column), f"not defined for the terms {terms} in this flow")
                  for key, (column, label) in METRICS.items()]
        found += [Metric("delay", f"time of these errors after the {self.since}", at["delay"]),
                  *training_metrics(self.description), *coefficient_metrics(self.description)]
        if self.source is not None and "source_a_priori" in self.tables:
            found += source_metrics(self.mach, self.tables["a_priori"], self.source["mach_turbulent"],
                                    self.tables["source_a_priori"])
        return found

    @property
    def origin(self) -> str:
        """A sentence on the flows of the training if they are others than that of this run; else ""."""
        if not self.others:
            return ""
        whose = "this flow" if self.source is None else (
            f"the flow of {self.source['path']}, where its weights come from")
        return f"{self.label}: trained on {', '.join(self.others)}, and not on {whose}."


def section(models: Mapping[str, TrainedModel]) -> Section:
    """Return the section on the models of several variants. Errors are those of the a-priori test at the last frame."""
    found = Section("models", "Models", "A-priori test: the model sees the true particles of a frame. Numbers are "
                    "those of the last frame.", notices=[each.origin for each in models.values() if each.origin],
                    metrics=side_by_side({each.label: each.metrics for each in models.values()}), folded=True)
    found.add_figure(
        "figure-3-a-priori", "A-priori errors and PDFs (the paper's Fig. 3)", lambda: a_priori(list(models.values())),
        "Dashed: the exact filtered pressure gradient alone. Grey: frames of the training window.")
    if trained := [each for each in models.values() if "history" in each.tables]:
        sources = {each.source["path"] for each in trained if each.source}
        found.add_figure("model-training", "Training of the models", lambda: draw_training(trained), "Total loss, and "
                         "validation error." + (f" Trained in {', '.join(sources)}." if sources else ""))
    return found


def draw_training(models: Sequence[TrainedModel]) -> Figure:
    """Draw the training of one model with all its losses, or the total losses of several models."""
    if len(models) == 1:
        return curves(models[0].tables["history"])
    return curves_of_several({each.label: (each.tables["history"], each.look[0]) for each in models})


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
def a_priori(models: Sequence[TrainedModel]) -> Figure:
    """Draw errors over the delay after the training window, and PDFs of truth and prediction at the last frame."""
    dense = [each for each in models if "density_rate_sample" in each.tables]
    figure, axes = panels(1, 3 if dense else 2, (4.0, 3.2), foot=0.1 + 0.2 * -(-(len(models) + 4) // 5))
    errors, first = axes[0, 0], models[0].tables["a_priori"]
    errors.plot([], [], color=TRUTH, linewidth=2.2, label="truth")
    for each in models:
        table, (colour, marker) = each.tables["a_priori"], each.look
        errors.plot(table["delay"], table["acceleration_error"], color=colour, marker=marker, markersize=4,
                    markevery=max(len(table["delay"]) // 8, 1), label=each.label)
    if "pressure_gradient_error" in first:
        errors.plot(first["delay"], first["pressure_gradient_error"], color=GUIDE, linestyle="--",
                    label="pressure gradient")
    errors.axhline(1, color=GUIDE, linestyle=":", linewidth=1.2, label="no model, and Gaussian")
    seen = first["delay"].min() < 0
    if seen:
        errors.axvspan(first["delay"].min() - 0.03 * np.ptp(first["delay"]), 0, color="#eeeeee", zorder=0)
        note(errors, "training", (first["delay"].min(), 1), ("data", "axes fraction"), (0, 0), va="top", fontsize=8)
    highest = max(each.tables["a_priori"]["acceleration_error"].max() for each in models)
    errors.set(title="A-priori error", ylabel="error of the acceleration", ylim=(0, max(1.1, 1.05 * highest)),
               xlabel="delay after the training window" if seen else "time after the release of the tracers")
    for axis, drawn, kind, title, symbol in zip(axes[0, 1:], (models, dense), ("acceleration", "density_rate"),
                                                ("Acceleration", "Density rate"), (r"$a$", r"$\dot\rho$")):
        draw_pdfs(axis, drawn, f"{kind}_sample")
        axis.set(title=f"{title} PDF", xlabel=f"{symbol} / standard deviation of the truth", ylabel="PDF")
    legend_at_foot(figure, errors, 5)
    letter(axes.flat)
    return figure


def draw_pdfs(axis: Axes, models: Sequence[TrainedModel], sample: str) -> None:
    """Draw the PDFs of true and predicted values and a Gaussian, in units of the standard deviation of the truth."""
    centres, truth = bin_centres(EDGES), models[0].tables[sample]["truth"]
    axis.semilogy(centres, gaussian(centres), color=GUIDE, linestyle=":")
    lines = [(standardized(truth), {"color": TRUTH, "linewidth": 2.2})]
    lines += [(standardized(each.tables[sample]["predicted"], each.tables[sample]["truth"]),
               {"color": each.look[0], "marker": each.look[1], "markersize": 3.5, "markevery": 4, "linewidth": 1.2})
              for each in models]
    for values, line in lines:
        density = pdf(values, EDGES)
        axis.semilogy(centres, np.where(density > 0, density, np.nan), **line)
    axis.set_ylim(0.4 / truth.size / (EDGES[1] - EDGES[0]), 2)
