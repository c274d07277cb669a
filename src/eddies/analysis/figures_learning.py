"""Learning curves: losses, validation error, learning rate and gradient over the wall time of a training."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eddies.analysis.figures import (
    DNS, FOURTH, GUIDE, MODEL, SECOND, THIRD, TRUTH, letter, panels, png, styled,
)

LOSSES = (
    ("loss", "total", DNS), ("trajectory_loss", "trajectory $L_t$", MODEL),
    ("field_loss", "field $L_f$", TRUTH), ("velocity_kl_loss", "velocity KL", SECOND),
    ("acceleration_kl_loss", "acceleration KL", FOURTH), ("rollout_loss", "velocity over the horizon", THIRD),
    ("energy_loss", "energy over the horizon", "#56B4E9"),
)
# Single steps see a small batch: their mean over this share of a phase's steps is drawn over them.
SMOOTHED = 0.04


@styled
def curves(history: Mapping[str, np.ndarray]) -> Figure:
    """The four curves over wall time, in which the phases of a training are of like length; dotted lines part them.

    history: columns (steps,); a loss that was not in use at a step is NaN there, one never used is absent.
    """
    figure, axes = panels(2, 2, (4.6, 2.9), sharex=True)
    (losses, errors), (rates, gradients) = axes
    for name, label, colour in LOSSES:
        if name in history and np.any(history[name] > 0):
            _noisy(losses, history, name, colour, label)
    losses.set(title="Losses", ylabel="loss", yscale="log")
    _validation(errors, history)
    for number in np.unique(history["phase"]):
        chosen = history["phase"] == number
        rates.semilogy(history["seconds"][chosen], history["learning_rate"][chosen], color=MODEL)
    rates.set(title="Learning rate", ylabel="learning rate", xlabel="wall time (s)")
    _noisy(gradients, history, "gradient_norm", MODEL, None)
    gradients.set(title="Norm of the gradient", ylabel="norm", xlabel="wall time (s)", yscale="log")
    for axis in axes.flat:
        for start in history["seconds"][np.flatnonzero(np.diff(history["phase"]) > 0)]:
            axis.axvline(start, color=GUIDE, linestyle=":", linewidth=1.0)
    figure.legend(*losses.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    letter(axes.flat)
    return figure


def picture(history: Mapping[str, np.ndarray]) -> bytes:
    """The same as a PNG image."""
    return png(curves(history))


def _validation(axis: Axes, history: Mapping[str, np.ndarray]) -> None:
    """Each phase has a measure of its own, so its points are joined with no others; the least is marked."""
    axis.set(title="Error on what is held out", ylabel="validation error")
    error = history.get("validation_error", np.full_like(history["step"], np.nan))
    phase = history["phase"]
    for number in np.unique(phase):
        chosen = np.isfinite(error) & (phase == number)
        if chosen.any():
            seconds, best = history["seconds"][chosen], np.argmin(error[chosen])
            axis.plot(seconds, error[chosen], color=MODEL, marker="o", markersize=3)
            axis.plot(seconds[best], error[chosen][best], marker="o", markersize=8, markerfacecolor="none", color=DNS)
    if np.isfinite(error).any():
        axis.set_ylim(0, 1.1 * np.nanmax(error))


def _noisy(axis: Axes, history: Mapping[str, np.ndarray], name: str, colour: str, label: str | None) -> None:
    """A curve of single steps, faint, under its running mean within each phase."""
    values = history[name]
    for number in np.unique(history["phase"]):
        used = (values > 0) & (history["phase"] == number)
        if not used.any():
            continue
        seconds, chosen = history["seconds"][used], values[used]
        axis.plot(seconds, chosen, color=colour, alpha=0.25, linewidth=0.6)
        width = max(int(SMOOTHED * len(chosen)), 1)
        mean = np.convolve(chosen, np.full(width, 1 / width), mode="valid")
        axis.plot(seconds[width - 1:], mean, color=colour, label=label, linewidth=1.4)
        label = None
