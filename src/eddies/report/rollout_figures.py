"""Figures of a rollout and the true tracers: the paper's Figs. 4 to 9, Lagrangian statistics, disorder."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from eddies.analysis import disorder
from eddies.analysis.against_truth import EDGES, InvariantStatistics, pdf_divergence
from eddies.analysis.lagrangian import PathStatistics
from eddies.analysis.pdfs import bin_centres
from eddies.analysis.rollout import Pair, Plane, SpectraAt
from eddies.analysis.velocity_gradients import ConditionalVelocity, vieillefosse_line
from eddies.report.figures import (BAR, DNS, FILTERED, FOURTH, GUIDE, MODEL, POSITIVE, SIGNED, TRUTH, colour_bar,
                                   draw_pdfs, guide_power_law, largest, legend_at_foot, letter, note,
                                   number_wavenumbers, panels, plain_log_ticks, show_plane, styled)

FEWEST = 8  # smallest number of particles in a cell of the Q-R plane for which its mean motion is drawn
LINES = {"truth": {"label": "true tracers", "color": TRUTH},
         "model": {"label": "model", "color": MODEL, "linestyle": "--"}}


@styled
def velocity_planes(rows: Mapping[str, Sequence[Plane]], times: Sequence[float]) -> Figure:
    """Draw u_x in planes [y, x], with a row of panels for each name in `rows` and a column for each time.

    Times are in turnovers. The planes of the first row determine the colour scale.
    """
    high, wide = len(rows), len(times)
    figure, axes = panels(high, wide, ((2.3 * wide + 1.46) / wide, (2.1 * high + 1.15) / high), right=BAR, sharex=True,
                          sharey=True)
    limit = largest(*(plane.velocity[0] for plane in next(iter(rows.values()))))
    for row, (name, planes) in zip(axes, rows.items()):
        for axis, plane in zip(row, planes):
            image = show_plane(axis, plane.velocity[0], (-limit, limit), SIGNED)
        row[0].set_ylabel(f"{name}\n$y$")
    for first, last, time in zip(axes[0], axes[-1], times):
        first.set_title(f"$t = {time:.2f}\\,T$")
        last.set_xlabel("$x$")
    colour_bar(figure, image, axes.flat, "$u_x$")
    letter(axes.flat)
    return figure


@styled
def vorticity_and_energy(planes: Mapping[str, Plane]) -> Figure:
    """Draw planes [y, x] of the vorticity magnitude, and below them of the kinetic energy.

    Each name in `planes` has a column of panels. The first plane of a row determines the colour scale of the row.
    """
    figure, axes = panels(2, len(planes), (2.6 + 2.1 / len(planes), 3.295), right=BAR, sharex=True, sharey=True)
    for row, quantity, label in zip(axes, (lambda plane: plane.vorticity, kinetic_energy),
                                    (r"$|\omega|$", r"$\frac{1}{2}|u|^2$")):
        shown = [quantity(plane) for plane in planes.values()]
        for axis, values in zip(row, shown):
            image = show_plane(axis, values, (0, largest(shown[0])), POSITIVE)
        colour_bar(figure, image, row, label, extend="max")
        row[0].set_ylabel("$y$")
    for first, last, name in zip(*axes, planes):
        first.set_title(name)
        last.set_xlabel("$x$")
    letter(axes.flat)
    return figure


def kinetic_energy(plane: Plane) -> np.ndarray:
    """Return |u|^2 / 2 in a plane, as an array [y, x]."""
    return np.sum(plane.velocity**2, axis=0) / 2


@styled
def errors_over_time(model: Mapping[str, np.ndarray], truth: Mapping[str, np.ndarray],
                     errors: Mapping[str, np.ndarray], turnover: float) -> Figure:
    """Draw energy, velocity error and divergences of PDFs over time, and the density rms if both runs have a density.

    model, truth: the results of `particle_series` for the two runs. errors: the result of `error_series`.
    """
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
        axis.set(xlabel="time $t/T$", xlim=(0, model["time"][-1] / turnover or None))  # a single frame is at time 0
    letter(figure.axes)
    return figure


@styled
def particle_pdfs(pairs: Mapping[str, Sequence[Pair]], turnover: float) -> Figure:
    """Draw the PDFs of velocity and acceleration. All three components count in one PDF.

    pairs: for "velocity" and for "acceleration", a Pair of arrays (n, 3) at each time.
    """
    times = len(pairs["velocity"])
    if times > 1:
        figure, axes = panels(2, times, (3.5, 2.6), foot=0.3, sharex="row", sharey="row")
    else:
        figure, axes = panels(1, 2, (4.6, 3.0), foot=0.3)
        axes = axes.T
    for row, quantity in zip(axes, ("velocity", "acceleration")):
        for axis, pair in zip(row, pairs[quantity]):
            draw_pdfs(axis, pair.truth, pair.model, EDGES[quantity])
            divergence = pdf_divergence(pair, EDGES[quantity])
            axis.set_title(f"$t = {pair.time / turnover:.2f}\\,T$,  KL {divergence:.2g}")
            axis.set_xlabel(f"${quantity[0]}$ / standard deviation of the truth")
        row[0].set_ylabel(f"{quantity} PDF")
    legend_at_foot(figure, axes[0, 0], 3)
    letter(axes.flat)
    return figure


@styled
def energy_spectra(series: Sequence[SpectraAt], flow: Mapping[str, np.ndarray], start_time: float, turnover: float,
                   filter_wavenumber: float) -> Figure:
    """Draw spectra of model and true tracers at several times, each with the DNS spectra of the nearest stored time.

    `flow` is the table of DNS spectra, with the columns `time` (m,), `wavenumber` (shells,), `energy` and `filtered`,
    each (m, shells). Time 0 of `series` is the time `start_time` of this table.
    """
    size = (3.5, 3.2) if len(series) > 1 else (5.6, 3.6)
    figure, axes = panels(1, len(series), size, foot=0.3, sharex=True, sharey=True)
    known = flow["wavenumber"] >= 1
    for axis, at in zip(axes.flat, series):
        nearest = int(np.argmin(np.abs(flow["time"] - (start_time + at.time))))
        for column, line in (("energy", {"color": DNS, "label": "DNS"}),
                             ("filtered", {"color": FILTERED, "linestyle": "--", "label": "filtered DNS"})):
            axis.loglog(flow["wavenumber"][known], flow[column][nearest][known], linewidth=1.3, **line)
        shells = at.wavenumber >= 1
        axis.loglog(at.wavenumber[shells], at.truth[shells], color=TRUTH, label="true tracers")
        axis.loglog(at.wavenumber[shells], at.model[shells], color=MODEL, linestyle="none", marker="o",
                    markersize=4, markerfacecolor="none", label="model")
        axis.axvline(filter_wavenumber, color=GUIDE, linestyle=":", linewidth=1)
        note(axis, r"$\pi/d$", (filter_wavenumber, 0.01), ("data", "axes fraction"), (3, 1))
        axis.set(title=f"$t = {at.time / turnover:.2f}\\,T$", xlabel="wavenumber $k$")
        number_wavenumbers(axis)
    peak, top = max(at.truth[1:].max() for at in series), 1.5 * series[0].wavenumber[-1]
    guide_power_law(axes[0, 0], (2, min(10, 0.7 * top)), 2.2 * peak, -5 / 3, r"$k^{-5/3}$")
    axes[0, 0].set(ylabel="$E(k)$", ylim=(1e-6 * peak, 6 * peak), xlim=(0.9, max(top, 2)))
    legend_at_foot(figure, axes[0, 0], 4)
    letter(axes.flat)
    return figure


@styled
def path_statistics(model: PathStatistics, truth: PathStatistics, turnover: float) -> Figure:
    """Draw statistics of velocity and acceleration along paths, pair dispersion, and the size and shape of tetrads."""
    figure, axes = panels(3, 3, (3.6, 2.6))
    (memory, structure, accelerations), (variance, flatness, pairs), (sizes, shapes, unused) = axes
    for run, name in ((truth, "truth"), (model, "model")):
        line, time, lags = LINES[name], run.times / turnover, run.lags / turnover
        memory.plot(time, run.velocity_correlation, **line)
        structure.loglog(lags, run.structure, marker="o", markersize=3, **line)
        accelerations.plot(lags, run.acceleration_correlation, marker="o", markersize=3, **line)
        variance.plot(time, run.acceleration_variance, **line)
        flatness.semilogx(lags, run.flatness, marker="o", markersize=3, **line)
        pairs.loglog(time[1:], run.pair_dispersion[1:], **line)
        sizes.plot(time, run.tetrad_size, **line)
        for eigenvalue in run.tetrad_shape.T:
            shapes.plot(time, eigenvalue, **line)
    memory.set(title="Velocity correlation", ylabel=r"$\rho_v(t)$")
    structure.set(title="Structure function", ylabel=r"$\langle(\Delta_\tau v_i)^2\rangle$")
    accelerations.set(title="Acceleration correlation", ylabel=r"$\rho_a(\tau)$")
    accelerations.axhline(0, color=GUIDE, linewidth=0.8)
    variance.set(title="Acceleration variance", ylabel=r"$\langle a_i^2\rangle$", ylim=(0, None))
    flatness.set(title="Flatness of increments", ylabel=r"$\langle\Delta v^4\rangle/\langle\Delta v^2\rangle^2$")
    flatness.axhline(3, color=GUIDE, linestyle=":")
    pairs.set(title="Pair dispersion", ylabel=r"$\langle|r-r_0|^2\rangle/\langle r_0^2\rangle$")
    sizes.set(title="Size of tetrads", ylabel=r"$\langle R^2\rangle/\langle R_0^2\rangle$", ylim=(0, None))
    shapes.set(title="Shape of tetrads", ylabel=r"$\langle\lambda_i/R^2\rangle$", ylim=(0, 1))
    shapes.axhline(1 / 3, color=GUIDE, linestyle=":")
    for axis in (memory, variance, pairs, sizes, shapes):
        axis.set_xlabel("time $t/T$")
    for axis in (structure, accelerations, flatness):
        axis.set_xlabel(r"lag $\tau/T$")
    for axis in (structure, flatness, pairs):
        number_wavenumbers(axis)
    unused.axis("off")
    unused.legend(*memory.get_legend_handles_labels(), loc="center")
    letter(axes.flat[:-1])
    return figure


@styled
def particle_disorder(distances: Mapping[str, np.ndarray], counts: Mapping[str, tuple[np.ndarray, Sequence[float]]],
                      turnover: float) -> Figure:
    """Draw the PDF of nearest-neighbour distances, and the variance of particle counts over time.

    Both mappings have the keys "truth" and "model". distances: probabilities (bins,) between the edges
    disorder.DISTANCE_EDGES. counts: times (frames,), and the variance of the counts at each time.
    """
    figure, axes = panels(1, 2, (4.0, 3.1))
    edges = disorder.DISTANCE_EDGES
    fine, centres = np.linspace(edges[0], edges[-1], 300), bin_centres(edges)
    nearest, variance = axes[0]
    nearest.plot(fine, disorder.random_distance_density(fine), color=GUIDE, linestyle=":", label="random points")
    for name, line in LINES.items():
        nearest.plot(centres, distances[name] / np.diff(edges), **line)
        times, variances = counts[name]
        variance.plot(times / turnover, variances, **line)
    nearest.set(title="Nearest neighbour", xlabel="distance / mean spacing", ylabel="PDF", ylim=(0, None))
    nearest.legend()
    variance.axhline(1, color=GUIDE, linestyle=":")
    variance.set(title="Variance of counts", ylabel="relative to random points", xlabel="time $t/T$", ylim=(0, None))
    letter(axes.flat)
    return figure


@styled
def invariant_plane(statistics: InvariantStatistics,
                    flows: tuple[ConditionalVelocity, ConditionalVelocity] | None) -> Figure:
    """Draw joint PDFs of (R, Q) and, if `flows` of model and truth are given, the mean (dR/dt, dQ/dt) at each (R, Q).

    The mean is drawn as an arrow, whose colour shows the magnitude. For the direction of the arrow, each rate is
    divided by the range of its axis. For the magnitude, each rate is in its own unit, which is a power of <Q_w>.
    """
    names = "true tracers", "model"
    figure, axes = panels(1 if flows is None else 2, 2, (4.3, 3.2), right=BAR + 0.1, sharex=True, sharey=True)
    bins = statistics.bins
    across, up = bin_centres(bins.third)[-2], bin_centres(bins.second)[-2]
    densities = [bins.density(cells) for cells in (statistics.truth, statistics.model)]
    # Two to eight contour levels, half a decade apart. The highest is just below the peak of the truth. If there are
    # more than two, the lowest is above the density of one particle.
    peak, single = (np.log10(extreme) for extreme in (densities[0].max(), densities[0][densities[0] > 0].min()))
    top = np.floor(2 * peak)
    levels = 10.0 ** (np.arange(top, min(2 * single, top - 1.5), -1)[:8][::-1] / 2)
    for axis, density, name in zip(axes[0], densities, names):
        # Outer cells are not drawn, because they also count all values beyond them. Empty cells get a value above 0.
        shown = np.maximum(density[1:-1, 1:-1], 1e-3 * levels[0])
        filled = axis.contourf(bin_centres(bins.third)[1:-1], bin_centres(bins.second)[1:-1], shown, levels,
                               cmap="YlGnBu", norm=LogNorm(levels[0], levels[-1]), extend="max")
        axis.set_title(f"joint PDF, {name}")
    bar = colour_bar(figure, filled, axes[0], "joint PDF", extend="neither")
    bar.set_ticks(levels[::2], labels=[f"{level:.0e}" for level in levels[::2]])
    if flows is not None:
        speeds = np.concatenate([np.hypot(*flow.mean(FEWEST)).ravel() for flow in flows])
        speeds = speeds[speeds > 0]
        norm = LogNorm(*np.quantile(speeds, (0.02, 0.98))) if speeds.size else None
        for axis, flow, name in zip(axes[1], flows[::-1], names):
            arrows = _draw_arrows(axis, flow, norm, 0.97 * across, 0.97 * up)
            axis.set_title(f"mean motion, {name}")
        bar = colour_bar(figure, arrows, axes[1], "speed")
        plain_log_ticks(bar.ax.yaxis)
    third = np.linspace(-across, across, 401)
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


def _draw_arrows(axis: Axes, flow: ConditionalVelocity, norm: LogNorm | None, third_limit: float, second_limit: float):
    """Draw arrows of equal length at the cells with |R| < `third_limit` and |Q| < `second_limit`, and return them.

    With these limits no arrow leaves the panel.
    """
    third, second = np.meshgrid(bin_centres(flow.bins.third), bin_centres(flow.bins.second))
    inside = (np.abs(third) < third_limit) & (np.abs(second) < second_limit)
    second_rate, third_rate = (rate[inside] for rate in flow.mean(FEWEST))
    across, up = third_rate / np.ptp(flow.bins.third), second_rate / np.ptp(flow.bins.second)
    length = np.hypot(across, up)
    length[length == 0] = np.nan
    return axis.quiver(third[inside], second[inside], across / length, up / length, np.hypot(second_rate, third_rate),
                       norm=norm, cmap="cividis", pivot="middle", scale=20, width=0.006, headwidth=4)
