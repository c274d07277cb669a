"""Figures of a rollout and the true tracers: fields (the paper's Figs. 4-5), errors in time."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from eddies.analysis.against_truth import Pair
from eddies.report.figures import (DNS, FOURTH, GUIDE, MODEL, POSITIVE, SIGNED, TRUTH, colour_bar, largest, letter,
                                   panels, show_plane, styled)

LINES = {"truth": {"label": "true tracers", "color": TRUTH},
         "model": {"label": "model", "color": MODEL, "linestyle": "--"}}


@styled
def velocity_planes(pairs: Sequence[Pair], turnover: float, truth_name: str) -> Figure:
    """u_x at z = pi over time: truth above, model below, one colour scale. Pairs of [y, x] planes."""
    figure, axes = panels(2, len(pairs), (2.7, 2.6), sharex=True, sharey=True)
    limit = largest(*(pair.truth for pair in pairs))
    for column, pair in zip(axes.T, pairs):
        image = show_plane(column[0], pair.truth, (-limit, limit), SIGNED)
        show_plane(column[1], pair.model, (-limit, limit), SIGNED)
        column[0].set_title(f"$t = {pair.time / turnover:.2f}\\,T$")
        column[1].set_xlabel("$x$")
    axes[0, 0].set_ylabel(f"{truth_name}\n$y$")
    axes[1, 0].set_ylabel("model\n$y$")
    colour_bar(figure, image, axes.flat, "$u_x$")
    letter(axes.flat)
    return figure


@styled
def vorticity_and_energy(vorticity: Pair, energy: Pair, truth_name: str) -> Figure:
    """Vorticity magnitude and kinetic energy in the plane z = pi: truth and model, one colour scale a row."""
    figure, axes = panels(2, 2, (3.2, 3.0), sharex=True, sharey=True)
    for row, pair, label in zip(axes, (vorticity, energy), (r"$|\omega|$", r"$\frac{1}{2}|u|^2$")):
        limit = largest(pair.truth)
        image = show_plane(row[0], pair.truth, (0, limit), POSITIVE)
        show_plane(row[1], pair.model, (0, limit), POSITIVE)
        colour_bar(figure, image, row, label, extend="max")
        row[0].set_ylabel("$y$")
    for axis, name in zip(axes[0], (truth_name, "model")):
        axis.set_title(name)
    for axis in axes[1]:
        axis.set_xlabel("$x$")
    letter(axes.flat)
    return figure


@styled
def errors_over_time(model: Mapping[str, np.ndarray], truth: Mapping[str, np.ndarray],
                     errors: Mapping[str, np.ndarray], turnover: float) -> Figure:
    """Energy, velocity error, PDF divergences and, where there is one, density rms over time; the model may outlast the
    truth."""
    figure, axes = panels(2, 2, (4.6, 2.8))
    energy, error, divergence, density = axes.flat
    initial = truth["energy"][0]
    for run, line in ((truth, LINES["truth"]), (model, LINES["model"])):
        time = run["time"] / turnover
        energy.plot(time, run["energy"] / initial, **line)
        if "density_rms" in run:
            density.plot(time, run["density_rms"], **line)
    energy.set(title="Kinetic energy", ylabel="$E(t)/E(0)$", ylim=(0, None))
    if density.lines:
        density.set(title="Density fluctuation", ylabel=r"$\rho_{rms}/\rho_0$", ylim=(0, None))
    else:
        density.remove()
    energy.legend()
    error.plot(errors["time"] / turnover, errors["velocity_error"], color=MODEL, label="model")
    error.plot(errors["time"] / turnover, errors["no_force"], color=GUIDE, linestyle="--", label="no force")
    error.legend()
    error.axhline(1, color=GUIDE, linestyle=":", linewidth=1.2)
    error.set(title="Velocity error", ylabel="normalised L2 by particle", ylim=(0, None))
    for column, colour, style in (("velocity_kl", DNS, "-"), ("acceleration_kl", FOURTH, "--")):
        divergence.plot(errors["time"] / turnover, errors[column], color=colour, linestyle=style,
                        label=column.removesuffix("_kl"))
    divergence.set(title="PDF divergence", ylabel="KL divergence (nats)", ylim=(0, None))
    divergence.legend()
    for axis in figure.axes:
        axis.set(xlabel="time $t/T$", xlim=(0, model["time"][-1] / turnover))
    letter(figure.axes)
    return figure
