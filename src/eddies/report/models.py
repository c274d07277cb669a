"""The report section on models: a-priori errors and PDFs (the paper's Fig. 3), training, learned coefficients."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eddies.analysis.pdfs import bin_centres, bin_edges, gaussian, pdf, standardized
from eddies.report import learning
from eddies.report.figures import GUIDE, WIDE, Table, Variant, legend_at_foot, letter, note, panels, styled
from eddies.report.page import Section
from eddies.report.page import shown as in_words

EDGES = bin_edges(8, 65)  # edges of the bins of the PDFs, in standard deviations of the truth
ERRORS = {  # key in the report: column of the table
    "acceleration_error": "acceleration_error", "true_density_acceleration_error": "true_density_acceleration_error",
    "density_rate_error": "density_rate_error", "filtered_pressure_gradient_error": "pressure_gradient_error"}
LABELS = {
    "acceleration_error": "acceleration error at the true state (a priori)",
    "true_density_acceleration_error": "acceleration error given the true density",
    "density_rate_error": "density rate error at the true state",
    "filtered_pressure_gradient_error": "acceleration error of the exact filtered pressure gradient",
    "delay": "time of these errors after the training window or, without one on this flow, the release of the tracers",
    "training_seconds": "wall seconds of the training, without reading and testing",
    "training_steps": "optimiser steps of the training, by phase",
    "training_error": "validation error at the end of each phase",
    "mach_turbulent": "turbulent Mach number M_t",
    "source_mach_turbulent": "M_t of the flow that the model was trained on",
    "source_acceleration_error": "mean acceleration error in that flow, after the training window",
    "unseen_acceleration_error": "mean acceleration error in this flow, after the training window"}
REASONS = {
    **dict.fromkeys(ERRORS, "not defined for the terms of this model in this flow"),
    **dict.fromkeys(("training_seconds", "training_steps", "training_error"),
                    "not stored with these weights, or the model has nothing to learn"),
    **dict.fromkeys(("mach_turbulent", "source_mach_turbulent"),
                    "an incompressible fluid has none, or it was not stored with these weights"),
    **dict.fromkeys(("source_acceleration_error", "unseen_acceleration_error"),
                    "no error after the training window is stored; train with a [training] window below 1")}


def section(models: Sequence[Variant]) -> Section:
    """Return the section on the models of several variants. Errors are those of the a-priori test at the last frame.

    The numbers of a variant are the description in model.h5 and, with the keys `provenance` and `others`, its
    provenance and the ground truths that it was trained on; these are empty if the ground truth of this run, or of the
    run where the weights come from, is among them. The tables are those of model.h5: `a_priori`, `acceleration_sample`
    and, if they exist, `density_rate_sample`, `history` and `source_a_priori`.
    """
    notices, labels, columns = [], dict(LABELS), {}
    for each in models:
        source, found = each.numbers["provenance"].get("source"), coefficients(each.numbers)
        labels |= {key: f"{key}: {one['meaning']}" for key, one in found.items()}
        columns[each.label] = {**numbers_of(each), **{key: written(one) for key, one in found.items()}}
        if each.numbers["others"]:
            whose = f"the flow of {source['path']}, where its weights come from" if source else "this flow"
            notices.append(f"{each.label}: trained on {', '.join(each.numbers['others'])}, and not on {whose}.")
    shown = Section("models", "Models", "A-priori test: the model sees the true particles of a frame. Numbers are "
                    "those of the last frame.", labels=labels, reasons=REASONS, columns=columns, notices=notices)
    shown.add_figure(
        "figure-3-a-priori", "A-priori errors and PDFs (the paper's Fig. 3)", lambda: a_priori(models),
        "Dashed: the exact filtered pressure gradient alone. Grey: frames of the training window.")
    if trained := [each for each in models if "history" in each.tables]:
        sources = {each.numbers["provenance"]["source"]["path"] for each in trained
                   if "source" in each.numbers["provenance"]}
        histories = {each.label: (each.tables["history"], each.look[0]) for each in trained}
        shown.add_figure("model-training", "Training of the models", lambda: learning.curves(histories), "Losses, and "
                         "validation error." + (f" Trained in {', '.join(sources)}." if sources else ""))
    return shown


def numbers_of(model: Variant) -> dict[str, Any]:
    """Return all numbers of a model."""
    provenance, table = model.numbers["provenance"], model.tables["a_priori"]
    last, phases = int(np.argmax(table["delay"])), model.numbers.get("training")
    found: dict[str, Any] = {"terms": ", ".join(model.numbers["terms"])}
    found |= {key: float(table[column][last]) if column in table else None for key, column in ERRORS.items()}
    found |= {"delay": float(table["delay"][last]),
              "training_seconds": None if phases is None else float(sum(phase["seconds"] for phase in phases)),
              "training_steps": {phase["phase"]: phase["steps"] for phase in phases or ()} or None,
              "training_error": {phase["phase"]: phase["error"] for phase in phases or ()} or None,
              **coefficients(model.numbers)}
    if "source_a_priori" in model.tables:
        found |= {"mach_turbulent": provenance["mach_turbulent"],
                  "source_mach_turbulent": provenance["source"]["mach_turbulent"],
                  "source_acceleration_error": unseen_error(model.tables["source_a_priori"]),
                  "unseen_acceleration_error": unseen_error(table)}
    return found


def unseen_error(table: Table) -> float | None:
    """Return the mean acceleration error over the frames after the training window; None if there are none."""
    chosen = table["acceleration_error"][table["delay"] > 0]
    return float(chosen.mean()) if len(chosen) else None


def coefficients(description: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the learned coefficients that the terms of the model declare."""
    return {f"{term} {each['name']}": {key: each[key] for key in ("learned", "value", "unit", "meaning")}
            for term, found in description.get("coefficients", {}).items() for each in found}


def written(coefficient: Mapping[str, Any]) -> str:
    """Return the text of a coefficient: its value as learned and, unless its unit is 1, in the units of the flow."""
    learned, value = (", ".join(map(in_words, found if isinstance(found, list) else [found]))
                      for found in (coefficient["learned"], coefficient["value"]))
    return learned if coefficient["unit"] == "1" else f"{learned}, that is {value} {coefficient['unit']}"


@styled
def a_priori(models: Sequence[Variant]) -> Figure:
    """Draw errors over the delay after the training window, and PDFs of truth and prediction at the last frame."""
    dense = [each for each in models if "density_rate_sample" in each.tables]
    figure, axes = panels(1, 3 if dense else 2, (4.0, 3.2))
    errors, first, highest = axes[0, 0], models[0].tables["a_priori"], 1.05
    errors.plot([], [], **WIDE, label="truth")
    for each in models:
        table = each.tables["a_priori"]
        errors.plot(table["delay"], table["acceleration_error"], **each.line(table))
        highest = max(highest, table["acceleration_error"].max())
    if "pressure_gradient_error" in first:
        errors.plot(first["delay"], first["pressure_gradient_error"], color=GUIDE, linestyle="--",
                    label="pressure gradient")
    errors.axhline(1, color=GUIDE, linestyle=":", linewidth=1.2, label="no model, and Gaussian")
    seen = first["delay"].min() < 0
    if seen:
        errors.axvspan(first["delay"].min() - 0.03 * np.ptp(first["delay"]), 0, color="#eeeeee", zorder=0)
        note(errors, "training", (first["delay"].min(), 1), ("data", "axes fraction"), (0, 0), va="top", fontsize=8)
    errors.set(title="A-priori error", ylabel="error of the acceleration", ylim=(0, 1.05 * highest),
               xlabel="delay after the training window" if seen else "time after the release of the tracers")
    for axis, drawn, kind, title, symbol in zip(axes[0, 1:], (models, dense), ("acceleration", "density_rate"),
                                                ("Acceleration", "Density rate"), (r"$a$", r"$\dot\rho$")):
        draw_pdfs(axis, drawn, f"{kind}_sample")
        axis.set(title=f"{title} PDF", xlabel=f"{symbol} / standard deviation of the truth", ylabel="PDF")
    legend_at_foot(figure, errors)
    letter(axes.flat)
    return figure


def draw_pdfs(axis: Axes, models: Sequence[Variant], sample: str) -> None:
    """Draw the PDFs of true and predicted values and a Gaussian, in units of the standard deviation of the truth."""
    centres, truth = bin_centres(EDGES), models[0].tables[sample]["truth"]
    axis.semilogy(centres, gaussian(centres), color=GUIDE, linestyle=":")
    lines = [(standardized(truth), WIDE)]
    lines += [(standardized(each.tables[sample]["predicted"], each.tables[sample]["truth"]),
               {**each.line({"": centres}), "linewidth": 1.2}) for each in models]
    for values, line in lines:
        density = pdf(values, EDGES)
        axis.semilogy(centres, np.where(density > 0, density, np.nan), **line)
    axis.set_ylim(0.4 / truth.size / (EDGES[1] - EDGES[0]), 2)
