"""Figures of the trained model: a-priori errors and PDFs (the paper's Fig. 3) and its training."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eddies.analysis.pdfs import bin_edges, bin_probabilities, gaussian, kl_divergence, pdf, standardized
from eddies.report.figures import DNS, FOURTH, GUIDE, MODEL, SECOND, TRUTH, legend_below, letter, panels, styled
from eddies.report.learning import curves
from eddies.report.page import Metric, Section, shown

ERRORS = (  # column of the table, label, colour, line style, marker
    ("acceleration_error", "model", MODEL, "-", "o"),
    ("true_density_acceleration_error", "model given the true density", FOURTH, "-", "s"),
    ("density_rate_error", "density rate of the model", SECOND, "-", "^"),
    ("pressure_gradient_error", "exact filtered pressure gradient", DNS, "--", None),
)
EDGES = bin_edges(8, 65)  # of the PDFs, in standard deviations of the truth
METRICS = {  # key in the report: column of the table, label
    "acceleration_error": ("acceleration_error", "acceleration error at the true state (a priori)"),
    "true_density_acceleration_error": (
        "true_density_acceleration_error", "the same given the true density"),
    "density_rate_error": ("density_rate_error", "density rate error at the true state"),
    "filtered_pressure_gradient_error": (
        "pressure_gradient_error", "acceleration error of the exact filtered pressure gradient"),
}

TRAINING = {
    "training_seconds": "wall seconds of the training, without reading and testing",
    "training_steps": "optimiser steps of the training, by phase",
    "training_error": "error on what is held out, at the end of each phase",
}


@styled
def a_priori(table: Mapping[str, np.ndarray], acceleration: Mapping[str, np.ndarray],
             density_rate: Mapping[str, np.ndarray] | None) -> Figure:
    """Errors over the delay after training, and PDFs of truth and prediction at the last frame.

    table: columns (frames,); acceleration: truth and predicted (m, 3); density_rate: the same (m,), or None.
    """
    figure, axes = panels(1, 2 if density_rate is None else 3, (3.9, 3.5))
    _errors_panel(axes[0, 0], table)
    _pdf_panel(axes[0, 1], acceleration, "Acceleration", r"$a$")
    if density_rate is not None:
        _pdf_panel(axes[0, 2], density_rate, "Density rate", r"$\dot\rho$")
    letter(axes.flat)
    return figure


def _positive(values: np.ndarray) -> np.ndarray:
    return np.where(np.asarray(values) > 0, values, np.nan)


def _errors_panel(axis: Axes, table: Mapping[str, np.ndarray]) -> None:
    delay = table["delay"]
    axis.axhline(1, color=GUIDE, linestyle=":", linewidth=1.2, label="no model")
    if delay.min() < 0:
        axis.axvspan(delay.min() - 0.03 * np.ptp(delay), 0, color="#eeeeee", zorder=0)
        axis.annotate("training", (delay.min(), 0.86), xycoords=("data", "axes fraction"), fontsize=9,
                      color="#5a5a5a", va="top")
    for column, label, colour, style, marker in ERRORS:
        if column in table:
            axis.plot(delay, table[column], color=colour, linestyle=style, marker=marker, markersize=4,
                      label=label)
    top = max(1.1, *(1.05 * table[column].max() for column, *_ in ERRORS if column in table))
    seen = delay.min() < 0
    axis.set(title="A-priori error", ylabel="normalised L2 error", ylim=(0, top),
             xlabel="delay after the training window" if seen else "time after the release of the tracers")
    legend_below(axis, 1)


def _pdf_panel(axis: Axes, sample: Mapping[str, np.ndarray], title: str, symbol: str) -> None:
    truth = sample["truth"]
    edges = EDGES
    centres = (edges[1:] + edges[:-1]) / 2
    axis.semilogy(centres, gaussian(centres), color=GUIDE, linestyle=":", label="Gaussian")
    axis.semilogy(centres, _positive(pdf(standardized(truth), edges)), color=TRUTH, label="truth")
    axis.semilogy(centres, _positive(pdf(standardized(sample["predicted"], truth), edges)), color=MODEL,
                  linestyle="none", marker="o", markersize=3.5, markerfacecolor="none", label="model")
    smallest = 0.3 / truth.size / (edges[1] - edges[0])
    axis.set(title=f"{title} PDF", xlabel=f"{symbol} / standard deviation of the truth", ylabel="PDF",
             ylim=(smallest, 2))
    legend_below(axis, 3)


def _training(description: Mapping[str, Any]) -> list[Metric]:
    """What the training cost, and the error on what is held out at the end of each phase."""
    if "training" not in description:
        return [Metric(key, label, None, "not stored with these weights") for key, label in TRAINING.items()]
    phases = description["training"]
    values = {"training_seconds": float(sum(phase["seconds"] for phase in phases)),
              "training_steps": {phase["phase"]: phase["steps"] for phase in phases} or None,
              "training_error": {phase["phase"]: phase["error"] for phase in phases} or None}
    return [Metric(key, label, values[key], "nothing is learned") for key, label in TRAINING.items()]


def _coefficients(description: Mapping[str, Any]) -> list[Metric]:
    """What each term has learned, as the terms declare it."""
    return [Metric(f"{term} {each['name']}", f"{term}, {each['name']}: {each['meaning']}",
                   {key: each[key] for key in ("learned", "value", "unit", "meaning")}, written=_written(each))
            for term, found in description.get("coefficients", {}).items() for each in found]


def _written(coefficient: Mapping[str, Any]) -> str:
    """As it was learned and, where that is another number, its value in the units of the flow."""
    learned, value = (", ".join(map(shown, found if isinstance(found, list) else [found]))
                      for found in (coefficient["learned"], coefficient["value"]))
    return learned if coefficient["unit"] == "1" else f"{learned}, that is {value} {coefficient['unit']}"


def section(description: Mapping[str, Any], table: Mapping[str, np.ndarray],
            acceleration: Mapping[str, np.ndarray], density_rate: Mapping[str, np.ndarray] | None,
            history: Mapping[str, np.ndarray] | None, source: str | None = None,
            others: Sequence[str] = ()) -> Section:
    """The model: a-priori figures and the errors at the last frame, from the tables.

    `source` names the run that the weights come from, if it is another; the history is that run's, and None where
    there was nothing to learn. `others` are ground truths that it was trained on, where that of this flow, or of the
    source's, is none of them.
    """
    last = int(np.argmax(table["delay"]))
    at = {name: float(values[last]) for name, values in table.items()}
    terms = ", ".join(description["terms"])
    missing = f"terms {terms} have none"
    metrics = [Metric(key, label, at.get(column), missing) for key, (column, label) in METRICS.items()]
    metrics.append(Metric("delay", "delay of these errors after what the model was trained on", at["delay"]))
    metrics += [*_training(description), *_coefficients(description)]
    since = "training window" if source is None else "release of the tracers, or the training window"
    trained = ""
    if others:
        whose = "this flow" if source is None else f"the flow of {source}, where its weights come from"
        trained = f" Trained on {', '.join(others)}, and on nothing of {whose}."
    if others and source is None:
        since = "release of the tracers"
    text = (f"Terms: {terms}.{trained} A-priori: the model sees the true particles of a frame. Numbers are of the last "
            f"frame, {at['delay']:.3g} after the {since}.")
    part = Section("model", "Model", text, metrics=metrics,
                   main=("acceleration_error", "filtered_pressure_gradient_error"))
    truth, predicted = acceleration["truth"], acceleration["predicted"]
    divergence = kl_divergence(bin_probabilities(standardized(truth), EDGES),
                               bin_probabilities(standardized(predicted, truth), EDGES))
    beside = ", that of no model 1"
    if "pressure_gradient_error" in at:
        beside = f"; that of the exact filtered pressure gradient alone is {at['pressure_gradient_error']:.3f}{beside}"
    part.add_figure(
        "figure-3-a-priori", "A-priori errors and PDFs (the paper's Fig. 3)",
        a_priori(table, acceleration, density_rate),
        f"At the last frame the acceleration error is {at['acceleration_error']:.3f}{beside}. KL "
        f"divergence of the acceleration PDF {divergence:.2g}. Grey: frames of the training window.")
    if history is not None:
        part.add_figure("model-training", "Training of the model", curves(history),
                        f"{int(history['step'][-1]) + 1} steps" + (f", in {source}." if source else "."))
    return part
