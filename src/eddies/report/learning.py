"""Learning curves: losses and validation error over the steps of a training."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eddies.clock import duration
from eddies.report.figures import (BLUE, DNS, FOURTH, GUIDE, MODEL, SECOND, THIRD, legend_at_foot, letter, panels,
                                   styled)

LOSSES = (
    ("loss", "total", DNS), ("trajectory_loss", "trajectory $L_t$", MODEL),
    ("field_loss", "field $L_f$", BLUE), ("velocity_kl_loss", "velocity KL", SECOND),
    ("acceleration_kl_loss", "acceleration KL", FOURTH), ("rollout_loss", "velocity over the horizon", THIRD),
    ("density_loss", "density over the horizon", "#7b3294"),
    ("energy_loss", "energy over the horizon", "#56B4E9"), ("power_loss", "power", "#8c564b"),
)
SMOOTHED = 0.04  # share of the steps of a phase over which a noisy curve is averaged


@styled
def curves(histories: Mapping[str, tuple[Mapping[str, np.ndarray], str]]) -> Figure:
    """Draw losses and validation errors over the steps of trainings, which are given with their colours by label. All
    phases are equally wide.

    A history has columns (steps,). A loss that is not used in a step is NaN; a loss that is never used has no column.
    One training has all its losses, each in a colour. Several have their total losses.
    """
    alone, x = len(histories) == 1, "phases of the training"
    figure, ((losses, errors),) = panels(1, 2, (5.3, 3.2), right=0.3 * alone, below=0.15 * alone)
    for label, (history, colour) in histories.items():
        history = _placed(history)
        for name, words, own in LOSSES if alone else (("loss", label, colour),):
            if name in history and np.any(history[name] > 0):
                _noisy(losses, history, name, own, words)
        _validation(errors, history, colour)
    losses.set(title="Losses", ylabel="loss" if alone else "total loss", yscale="log", xlabel=x)
    errors.set(title="Validation error, minima circled", ylabel="validation error", ylim=(0, None), xlabel=x)
    for axis in (losses, errors) if alone else ():
        _mark_phases(axis, history)
    legend_at_foot(figure, losses)
    letter((losses, errors))
    return figure


def _placed(history: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return a history with a column `place`. Steps of the first phase have places in (0, 1], those of the second in
    (1, 2], and so on."""
    _, index, count = np.unique(history["phase"], return_inverse=True, return_counts=True)
    before = np.cumsum(count) - count
    return {**history, "place": index + (np.arange(len(index)) - before[index] + 1) / count[index]}


def _mark_phases(axis: Axes, history: Mapping[str, np.ndarray]) -> None:
    """Draw vertical lines between the phases, and label ticks with numbers of steps and wall times."""
    phases = round(history["place"][-1])
    for end in range(1, phases):
        axis.axvline(end, color=GUIDE, linestyle=":", linewidth=1.0)
    wanted = np.linspace(0, phases, 4 + 1)[1:]
    shown = np.unique(np.searchsorted(history["place"], wanted - 1e-9))
    labels = [f"{int(history['step'][row]) + 1}\n{duration(history['seconds'][row])}" for row in shown]
    axis.set_xticks([0, *history["place"][shown]], ["0", *labels])
    axis.set_xlabel("steps and wall time")


def _validation(axis: Axes, history: Mapping[str, np.ndarray], colour: str) -> None:
    """Draw a line of validation errors for each phase, and a circle at the minimum of each line.

    Phases have separate lines because they measure errors in different ways. A line begins with the error before the
    first step of the phase.
    """
    missing = np.full(len(history["step"]), np.nan)
    after, before = (history.get(name, missing) for name in ("validation_error", "start_error"))
    for index, number in enumerate(np.unique(history["phase"])):
        chosen = history["phase"] == number
        place = np.append(index, history["place"][chosen])
        error = np.append(before[chosen][0], after[chosen])
        place, error = place[np.isfinite(error)], error[np.isfinite(error)]
        if len(error):
            axis.plot(place, error, color=colour, marker="o", markersize=3)
            axis.plot(place[np.argmin(error)], error.min(), marker="o", markersize=8, markerfacecolor="none", color=DNS)


def _noisy(axis: Axes, history: Mapping[str, np.ndarray], name: str, colour: str, label: str) -> None:
    """Draw a faint curve of the values of single steps and, over this curve, its running mean within each phase."""
    values = history[name]
    for number in np.unique(history["phase"]):
        used = (values > 0) & (history["phase"] == number)
        if not used.any():
            continue
        place, chosen = history["place"][used], values[used]
        axis.plot(place, chosen, color=colour, alpha=0.25, linewidth=0.6)
        width = max(int(SMOOTHED * len(chosen)), 1)
        mean = np.convolve(chosen, np.full(width, 1 / width), mode="valid")
        # A single step is drawn as a dot, because it makes no line.
        axis.plot(place[width - 1:], mean, color=colour, linewidth=1.4, marker="." if len(chosen) == 1 else None)
    axis.plot([], [], color=colour, label=label)
