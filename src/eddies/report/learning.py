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
    ("density_loss", "density over the horizon", "#e377c2"),
    ("energy_loss", "energy over the horizon", "#56B4E9"), ("power_loss", "power", "#8c564b"),
)
SMOOTHED = 0.04  # share of the steps of a phase over which a noisy curve is averaged


@styled
def curves(history: Mapping[str, np.ndarray]) -> Figure:
    """Draw losses and validation errors over the steps of a training. All phases are equally wide.

    history: columns (steps,). A loss that is not used in a step is NaN; a loss that is never used has no column.
    """
    history = _placed(history)
    figure, axes = panels(1, 2, (5.3, 3.2), below=0.15, foot=0.5)
    losses, errors = axes[0]
    for name, label, colour in LOSSES:
        if name in history and np.any(history[name] > 0):
            _noisy(losses, history, name, colour, label)
    losses.set(title="Losses", ylabel="loss", yscale="log")
    _validation(errors, history)
    for axis in axes.flat:
        _mark_phases(axis, history)
    legend_at_foot(figure, losses, 4)
    letter(axes.flat)
    return figure


@styled
def curves_of_several(histories: Mapping[str, tuple[Mapping[str, np.ndarray], str]]) -> Figure:
    """Draw total losses and validation errors of several trainings over the share of the steps, all phases equally
    wide. The histories and their colours are given by label."""
    figure, ((losses, errors),) = panels(1, 2, (5.3, 3.2), foot=0.1 + 0.2 * -(-len(histories) // 5))
    for label, (history, colour) in histories.items():
        history = _placed(history)
        history["place"] = history["place"] / history["place"][-1]
        _noisy(losses, history, "loss", colour, label)
        error = history.get("validation_error", np.full(len(history["step"]), np.nan))
        for number in np.unique(history["phase"]):
            chosen = (history["phase"] == number) & np.isfinite(error)
            errors.plot(history["place"][chosen], error[chosen], color=colour, marker="o", markersize=3)
    losses.set(title="Losses", ylabel="total loss", yscale="log", xlabel="share of the training, phases equally wide")
    errors.set(title="Validation error", ylabel="validation error", ylim=(0, None),
               xlabel="share of the training, phases equally wide")
    legend_at_foot(figure, losses, 5)
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


def _validation(axis: Axes, history: Mapping[str, np.ndarray]) -> None:
    """Draw a line of validation errors for each phase, and a circle at the minimum of each line.

    Phases have separate lines because they measure errors in different ways. A line begins with the error before the
    first step of the phase.
    """
    axis.set(title="Validation error, minima circled", ylabel="validation error")
    missing, highest = np.full(len(history["step"]), np.nan), 0.0
    after, before = (history.get(name, missing) for name in ("validation_error", "start_error"))
    for index, number in enumerate(np.unique(history["phase"])):
        chosen = history["phase"] == number
        place = np.append(index, history["place"][chosen])
        error = np.append(before[chosen][0], after[chosen])
        place, error = place[np.isfinite(error)], error[np.isfinite(error)]
        if len(error):
            best, highest = np.argmin(error), max(highest, error.max())
            axis.plot(place, error, color=MODEL, marker="o", markersize=3)
            axis.plot(place[best], error[best], marker="o", markersize=8, markerfacecolor="none", color=DNS)
    if highest > 0:
        axis.set_ylim(0, 1.1 * highest)


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
