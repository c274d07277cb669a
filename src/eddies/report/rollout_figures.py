"""Figures of a rollout and the true tracers: fields (the paper's Figs. 4-5), errors in time, PDFs of particles (Fig. 6)
and the Q-R plane (Fig. 7)."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from eddies.analysis.against_truth import EDGES, InvariantStatistics, pdf_divergence
from eddies.analysis.pdfs import gaussian, pdf, standardized
from eddies.analysis.rollout import Pair
from eddies.analysis.velocity_gradients import ConditionalVelocity, InvariantBins, vieillefosse_line
from eddies.report.figures import (DNS, FOURTH, GUIDE, MODEL, POSITIVE, SIGNED, TRUTH, colour_bar, largest, letter,
                                   panels, show_plane, styled)

FEWEST = 8  # particles a cell needs before its conditional mean is drawn
LINES = {"truth": {"label": "true tracers", "color": TRUTH},
         "model": {"label": "model", "color": MODEL, "linestyle": "--"}}


@styled
def velocity_planes(pairs: Sequence[Pair], turnover: float) -> Figure:
    """u_x at z = pi over time: truth above, model below, one colour scale. Pairs of [y, x] planes."""
    figure, axes = panels(2, len(pairs), (2.7, 2.6), sharex=True, sharey=True)
    limit = largest(*(pair.truth for pair in pairs))
    for column, pair in zip(axes.T, pairs):
        image = show_plane(column[0], pair.truth, (-limit, limit), SIGNED)
        show_plane(column[1], pair.model, (-limit, limit), SIGNED)
        column[0].set_title(f"$t = {pair.time / turnover:.2f}\\,T$")
        column[1].set_xlabel("$x$")
    axes[0, 0].set_ylabel("true tracers\n$y$")
    axes[1, 0].set_ylabel("model\n$y$")
    colour_bar(figure, image, axes.flat, "$u_x$")
    letter(axes.flat)
    return figure


@styled
def vorticity_and_energy(vorticity: Pair, energy: Pair) -> Figure:
    """Vorticity magnitude and kinetic energy in the plane z = pi: truth and model, one colour scale a row."""
    figure, axes = panels(2, 2, (3.2, 3.0), sharex=True, sharey=True)
    for row, pair, label in zip(axes, (vorticity, energy), (r"$|\omega|$", r"$\frac{1}{2}|u|^2$")):
        limit = largest(pair.truth)
        image = show_plane(row[0], pair.truth, (0, limit), POSITIVE)
        show_plane(row[1], pair.model, (0, limit), POSITIVE)
        colour_bar(figure, image, row, label, extend="max")
        row[0].set_ylabel("$y$")
    for axis, name in zip(axes[0], ("true tracers", "model")):
        axis.set_title(name)
    for axis in axes[1]:
        axis.set_xlabel("$x$")
    letter(axes.flat)
    return figure


@styled
def errors_over_time(model: Mapping[str, np.ndarray], truth: Mapping[str, np.ndarray],
                     errors: Mapping[str, np.ndarray], turnover: float) -> Figure:
    """Energy, velocity error, PDF divergences and, where both have one, density rms over time; the model may outlast
    the truth."""
    figure, axes = panels(2, 2, (4.6, 2.8))
    energy, error, divergence, density = axes.flat
    initial = truth["energy"][0]
    for run, line in ((truth, LINES["truth"]), (model, LINES["model"])):
        time = run["time"] / turnover
        energy.plot(time, run["energy"] / initial, **line)
        if "density_rms" in model and "density_rms" in truth:
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


@styled
def particle_pdfs(pairs: Mapping[str, Sequence[Pair]], turnover: float) -> Figure:
    """PDFs of all velocity components (above) and acceleration components (below) at several times.

    pairs: "velocity" and "acceleration", each one Pair of (n, 3) a time; both are standardised by the truth.
    """
    rows = ("velocity", "acceleration")
    figure, axes = panels(2, len(pairs["velocity"]), (3.3, 2.8), sharex="row", sharey="row")
    for row, quantity in zip(axes, rows):
        for axis, pair in zip(row, pairs[quantity]):
            _pdf_panel(axis, pair, EDGES[quantity])
            divergence = pdf_divergence(pair, EDGES[quantity])
            axis.set_title(f"$t = {pair.time / turnover:.2f}\\,T$,  KL {divergence:.2g}")
            axis.set_xlabel(f"${quantity[0]}$ / standard deviation of the truth")
        row[0].set_ylabel(f"{quantity} PDF")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncol=3)
    letter(axes.flat)
    return figure


@styled
def invariant_plane(statistics: InvariantStatistics,
                    flows: tuple[ConditionalVelocity, ConditionalVelocity] | None) -> Figure:
    """Joint PDFs of (R, Q), truth and model, at the same levels; below, the mean (dR/dt, dQ/dt) on condition
    of both, from the `flows` of model and truth.

    Arrows show the direction on the page; colour is the speed in the plane, one scale for both.
    """
    rows = 1 if flows is None else 2
    figure, axes = panels(rows, 2, (4.0, 3.5), sharex=True, sharey=True)
    densities = [_smoothed(statistics.bins.density(cells)) for cells in (statistics.truth, statistics.model)]
    levels = _levels(densities[0])
    for axis, density, name in zip(axes[0], densities, ("true tracers", "model")):
        filled = _joint_panel(axis, statistics.bins, density, levels)
        axis.set_title(f"joint PDF, {name}")
    bar = colour_bar(figure, filled, axes[0], "joint PDF", extend="neither")
    bar.set_ticks(levels[::2], labels=[f"{level:.0e}" for level in levels[::2]])
    if flows is not None:
        _flow_row(figure, axes[1], flows[::-1], statistics.bins)
    for axis in axes.flat:
        _plane_axes(axis, statistics.bins)
    for axis in axes[:, 0]:
        axis.set_ylabel(r"$Q\,/\,\langle Q_w\rangle$")
    for axis in axes[-1]:
        axis.set_xlabel(r"$R\,/\,\langle Q_w\rangle^{3/2}$")
    letter(axes.flat)
    return figure


def _pdf_panel(axis: Axes, pair: Pair, edges: np.ndarray) -> None:
    centres = (edges[1:] + edges[:-1]) / 2
    densities = (pdf(standardized(pair.truth), edges), pdf(standardized(pair.model, pair.truth), edges))
    truth, model = (np.where(density > 0, density, np.nan) for density in densities)
    axis.semilogy(centres, gaussian(centres), color=GUIDE, linestyle=":", label="Gaussian")
    axis.semilogy(centres, truth, color=TRUTH, label="true tracers")
    axis.semilogy(centres, model, color=MODEL, linestyle="none", marker="o", markersize=3.2,
                  markerfacecolor="none", label="model")
    axis.set_ylim(0.4 / pair.truth.size / (edges[1] - edges[0]), 2)


def _levels(density: np.ndarray) -> np.ndarray:
    """Levels half a decade apart, from the peak of the truth down to what a single particle resolves."""
    exponents = np.arange(np.floor(2 * np.log10(density.max())), 2 * np.log10(density[density > 0].min()), -1)
    return 10.0 ** (exponents[:8][::-1] / 2)


def _joint_panel(axis: Axes, bins: InvariantBins, density: np.ndarray, levels: np.ndarray):
    """Filled isolines of the inner cells: the outer ones also hold what lies beyond."""
    inner = np.s_[1:-1]
    third, second = _centres(bins.third)[inner], _centres(bins.second)[inner]
    shown = np.maximum(density[inner, inner], 1e-3 * levels[0])  # an empty cell has no logarithm
    filled = axis.contourf(third, second, shown, levels, cmap="YlGnBu", norm=LogNorm(levels[0], levels[-1]),
                           extend="max")
    axis.contour(third, second, shown, levels, colors="#303030", linewidths=0.7)
    return filled


def _flow_row(figure: Figure, row: Sequence[Axes], flows: Sequence[ConditionalVelocity], bins: InvariantBins) -> None:
    speeds = [np.hypot(*flow.mean(FEWEST)) for flow in flows]
    known = np.concatenate([speed[speed > 0] for speed in speeds])
    norm = LogNorm(*np.quantile(known, (0.02, 0.98))) if known.size else None
    for axis, flow, name in zip(row, flows, ("true tracers", "model")):
        arrows = _arrows(axis, flow, norm, _limits(bins))
        axis.set_title(f"mean motion, {name}")
    colour_bar(figure, arrows, row, r"$|(dR/dt,\ dQ/dt)|$, normalised")


def _arrows(axis: Axes, flow: ConditionalVelocity, norm: LogNorm | None, limits: tuple[float, float]):
    """Arrows of one length in the cells that lie well inside the limits, so that the frame cuts none."""
    third, second = _centres(flow.bins.third), _centres(flow.bins.second)
    inside = np.ix_(np.abs(second) < 0.97 * limits[1], np.abs(third) < 0.97 * limits[0])
    second_rate, third_rate = (rate[inside] for rate in flow.mean(FEWEST))
    across, up = third_rate / np.ptp(flow.bins.third), second_rate / np.ptp(flow.bins.second)
    length = np.hypot(across, up)
    length[length == 0] = np.nan
    return axis.quiver(third[inside[1][0]], second[inside[0][:, 0]], across / length, up / length,
                       np.hypot(second_rate, third_rate), norm=norm, cmap="cividis", pivot="middle", scale=20,
                       width=0.006, headwidth=4)


def _plane_axes(axis: Axes, bins: InvariantBins) -> None:
    third = np.linspace(bins.third[0], bins.third[-1], 401)
    axis.plot(third, vieillefosse_line(third), color=MODEL, linewidth=1.3)
    axis.axhline(0, color=GUIDE, linewidth=0.6, zorder=0)
    axis.axvline(0, color=GUIDE, linewidth=0.6, zorder=0)
    across, up = _limits(bins)
    axis.set(xlim=(-across, across), ylim=(-up, up))


def _limits(bins: InvariantBins) -> tuple[float, float]:
    """Largest |R| and |Q| shown: the centres of the last cells but one."""
    return float(_centres(bins.third)[-2]), float(_centres(bins.second)[-2])


def _centres(edges: np.ndarray) -> np.ndarray:
    return (edges[1:] + edges[:-1]) / 2


def _smoothed(density: np.ndarray) -> np.ndarray:
    """Binomial (1, 2, 1)/4 smoothing along both axes: only for drawing, the divergence uses the raw cells."""
    for axis in (0, 1):
        edge = [(1, 1) if a == axis else (0, 0) for a in (0, 1)]
        padded = np.swapaxes(np.pad(density, edge, mode="edge"), 0, axis)
        density = np.swapaxes((padded[:-2] + 2 * padded[1:-1] + padded[2:]) / 4, 0, axis)
    return density
