"""Invariants Q and R of the velocity gradient (the paper's Fig. 7): one figure and its numbers."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from eddies.analysis.against_truth import InvariantStatistics, conditional_flows, last_invariants
from eddies.analysis.rollout import Rollout
from eddies.analysis.velocity_gradients import ConditionalVelocity, InvariantBins, vieillefosse_line
from eddies.report.figures import BAR, GUIDE, MODEL, colour_bar, letter, panels, styled
from eddies.report.page import Metric, Section

FEWEST = 8  # particles that a cell needs before its conditional mean is drawn


def add(shown: Section, run: Rollout, main: bool) -> None:
    """Add the figure and its numbers, at the last common time, to the section of the rollout.

    The main page also shows the mean motion in the plane.
    """
    statistics = last_invariants(run)
    shown.metrics += [
        Metric("qr_kl", "KL divergence of the Q–R joint PDF", statistics.divergence),
        Metric("qr_kl_floor", "KL divergence between two samples of the true Q–R plane, of the same size",
               statistics.floor)]
    flows = conditional_flows(run, statistics.bins) if main else None
    shown.add_figure(
        "figure-7-invariants", "Invariants Q and R of the velocity gradient (the paper's Fig. 7)",
        invariant_plane(statistics, flows),
        f"Joint PDF at t = {run.common.times[-1] / run.turnover:.2f} T. Isolines are half a decade apart and "
        f"smoothed over one bin. KL divergence of the raw bins: {statistics.divergence:.2g}; between samples of the "
        f"truth: {statistics.floor:.2g}. Orange: Vieillefosse line. Units: the truth's ⟨Q_w⟩ = ⟨W:W⟩/2."
        + (" Bottom: mean motion over all frames until then." if flows else ""))


@styled
def invariant_plane(statistics: InvariantStatistics,
                    flows: tuple[ConditionalVelocity, ConditionalVelocity] | None) -> Figure:
    """Draw joint PDFs of (R, Q), and below them the conditional mean (dR/dt, dQ/dt) from `flows` of model and truth.

    Arrows show directions on the page; colour is the speed in the plane.
    """
    rows = 1 if flows is None else 2
    figure, axes = panels(rows, 2, (4.3, 3.2), right=BAR + 0.1, sharex=True, sharey=True)
    densities = [_smoothed(statistics.bins.density(cells)) for cells in (statistics.truth, statistics.model)]
    levels = _levels(densities[0])
    for axis, density, name in zip(axes[0], densities, ("true tracers", "model")):
        filled = _joint_panel(axis, statistics.bins, density, levels)
        axis.set_title(f"joint PDF, {name}")
    bar = colour_bar(figure, filled, axes[0], "joint PDF", extend="neither")
    bar.set_ticks(levels[::2], labels=[f"{level:.0e}" for level in levels[::2]])
    if flows is not None:
        _flow_row(figure, axes[1], flows[::-1], statistics.bins)
    third = np.linspace(statistics.bins.third[0], statistics.bins.third[-1], 401)
    across, up = _limits(statistics.bins)
    for axis in axes.flat:
        axis.plot(third, vieillefosse_line(third), color=MODEL, linewidth=1.3)
        axis.axhline(0, color=GUIDE, linewidth=0.6, zorder=0)
        axis.axvline(0, color=GUIDE, linewidth=0.6, zorder=0)
        axis.set(xlim=(-across, across), ylim=(-up, up))
    for axis in axes[:, 0]:
        axis.set_ylabel(r"$Q\,/\,\langle Q_w\rangle$")
    for axis in axes[-1]:
        axis.set_xlabel(r"$R\,/\,\langle Q_w\rangle^{3/2}$")
    letter(axes.flat)
    return figure


def _levels(density: np.ndarray) -> np.ndarray:
    """Return levels half a decade apart, from the peak of the truth down to the density of a single particle."""
    exponents = np.arange(np.floor(2 * np.log10(density.max())), 2 * np.log10(density[density > 0].min()), -1)
    return 10.0 ** (exponents[:8][::-1] / 2)


def _joint_panel(axis: Axes, bins: InvariantBins, density: np.ndarray, levels: np.ndarray):
    """Draw filled isolines of the inner cells; the outer cells also count all values beyond them."""
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
    """Draw arrows of equal length in the cells well inside the limits, so that the frame cuts no arrow."""
    third, second = _centres(flow.bins.third), _centres(flow.bins.second)
    inside = np.ix_(np.abs(second) < 0.97 * limits[1], np.abs(third) < 0.97 * limits[0])
    second_rate, third_rate = (rate[inside] for rate in flow.mean(FEWEST))
    across, up = third_rate / np.ptp(flow.bins.third), second_rate / np.ptp(flow.bins.second)
    length = np.hypot(across, up)
    length[length == 0] = np.nan
    return axis.quiver(third[inside[1][0]], second[inside[0][:, 0]], across / length, up / length,
                       np.hypot(second_rate, third_rate), norm=norm, cmap="cividis", pivot="middle", scale=20,
                       width=0.006, headwidth=4)


def _limits(bins: InvariantBins) -> tuple[float, float]:
    """Return the largest |R| and |Q| shown: the centres of the last cells but one."""
    return float(_centres(bins.third)[-2]), float(_centres(bins.second)[-2])


def _centres(edges: np.ndarray) -> np.ndarray:
    return (edges[1:] + edges[:-1]) / 2


def _smoothed(density: np.ndarray) -> np.ndarray:
    """Smooth with the weights (1, 2, 1)/4 along both axes, for drawing only."""
    for axis in (0, 1):
        edge = [(1, 1) if a == axis else (0, 0) for a in (0, 1)]
        padded = np.swapaxes(np.pad(density, edge, mode="edge"), 0, axis)
        density = np.swapaxes((padded[:-2] + 2 * padded[1:-1] + padded[2:]) / 4, 0, axis)
    return density
