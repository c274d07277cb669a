"""Figures of rollouts beside the true tracers: the paper's Figs. 4 to 9, Lagrangian statistics, disorder.

Each function draws the measures of several variants and their common truth, which it takes from the first variant.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from eddies.analysis import disorder
from eddies.analysis.against_truth import EDGES
from eddies.analysis.errors import normalized_l2
from eddies.analysis.pdfs import bin_centres, gaussian
from eddies.analysis.velocity_gradients import vieillefosse_line
from eddies.clock import SAME
from eddies.report.figures import (BAR, DNS, FILTERED, GUIDE, MODEL, POSITIVE, SIGNED, TRUTH, WIDE, Table, Variant,
                                   colour_bar, guide_power_law, largest, legend_at_foot, letter, mark_cutoff, note,
                                   number_wavenumbers, panels, plain_log_ticks, show_plane, styled)

TRUE = "true tracers"
OUTER_BINS = "outer bins: all beyond"  # a note in panels of PDFs
Variants = Sequence[Variant]


def turnover_of(variants: Variants) -> float:
    """Return the eddy turnover time T, the unit of time in the figures."""
    return float(variants[0].numbers["attributes"]["eddy_turnover_time"])


def of_all(variants: Variants, *names: str) -> Iterator[tuple[list[Table], str, dict[str, Any]]]:
    """Yield tables, "truth" or "model", and the style of a line: first of the truth, then of each variant.

    In the names of the tables, {} stands for "truth" or "model".
    """
    yield [variants[0].tables[name.format("truth")] for name in names], "truth", {**WIDE, "label": TRUE}
    for each in variants:
        tables = [each.tables[name.format("model")] for name in names]
        yield tables, "model", each.line(tables[0])


def row_at(table: Table, time: float) -> int | None:
    """Return the row of a table at a time, or None."""
    times = table["time"]
    row = int(np.argmin(np.abs(times - time)))
    return row if abs(times[row] - time) <= SAME * max(times.max(), abs(time), 1e-300) else None


def after_start(times: np.ndarray) -> np.ndarray:
    """The times after the start, where all variants are alike; the start if there are none."""
    return times[times > 0] if (times > 0).any() else times


@styled
def velocity_planes(variants: Variants) -> Figure:
    """Draw u_x in planes [y, x], with a row of panels for the truth and for each variant, and a column for each time
    after the start.

    The planes of the truth determine the colour scale. Each panel of a variant has its normalised L2 difference from
    the truth. A panel without a frame of the variant is empty.
    """
    truth = variants[0].tables["planes"]
    times = after_start(truth["time"])
    high, wide = 1 + len(variants), len(times)
    figure, axes = panels(high, wide, ((2.3 * wide + 1.46) / wide, (2.1 * high + 1.15) / high), right=BAR, sharex=True,
                          sharey=True)
    limit = largest(*truth["u_x_truth"])
    for row, ((table,), of, line) in zip(axes, of_all(variants, "planes")):
        for axis, time, true in zip(row, times, truth["u_x_truth"][-wide:]):
            if (at := row_at(table, time)) is not None:
                plane = table[f"u_x_{of}"][at]
                image = show_plane(axis, plane, (-limit, limit), SIGNED, _difference(plane, true, of))
            else:
                axis.set_aspect("equal")
                note(axis, "no frame", (0.5, 0.5), "axes fraction", (0, 0), ha="center")
        row[0].set_ylabel(f"{line['label']}\n$y$")
    for top, last, time in zip(axes[0], axes[-1], times):
        top.set_title(f"$t = {time / turnover_of(variants):.2f}\\,T$")
        last.set_xlabel("$x$")
    colour_bar(figure, image, axes.flat, "$u_x$")
    return figure


@styled
def vorticity_and_energy(variants: Variants) -> Figure:
    """Draw planes [y, x] of the vorticity magnitude, and below them of the kinetic energy, at the last time of each
    variant. The truth has the first column of panels. A row has one colour scale, which holds the values of all
    variants; colours go with the square root. Each panel has its normalised L2 difference from the truth."""
    wide = 1 + len(variants)
    figure, axes = panels(2, wide, (2.1 + 2.1 / wide, 2.9), right=BAR, sharex=True, sharey=True)
    for row, label, column in zip(axes, (r"$|\omega|$", r"$\frac{1}{2}|u|^2$"), ("vorticity", "energy")):
        planes = [(table[f"{column}_{of}"][-1], of, line) for (table,), of, line in of_all(variants, "planes")]
        limit = largest(*(plane for plane, *_ in planes))
        for axis, (plane, of, line) in zip(row, planes):
            image = show_plane(axis, plane, (0, limit), POSITIVE, _difference(plane, planes[0][0], of), power=0.5)
            if column == "vorticity":
                axis.set_title(line["label"])
            else:
                axis.set_xlabel("$x$")
        colour_bar(figure, image, row, label, extend="max")
        row[0].set_ylabel("$y$")
    return figure


def _difference(plane: np.ndarray, truth: np.ndarray, of: str) -> float | None:
    """Return the normalised L2 difference of a plane from the truth; None for the truth itself."""
    return None if of == "truth" else normalized_l2(plane, truth)


@styled
def errors_over_time(variants: Variants) -> Figure:
    """Draw velocity error, energy, density rms if there is a density, and divergences of PDFs over time."""
    truth, turnover = variants[0].tables["truth"], turnover_of(variants)
    figure, axes = panels(2, 3, (3.6, 2.7))
    error, energy, density, velocity, acceleration, unused = axes.flat
    longest = max((each.tables["errors"] for each in variants), key=lambda errors: errors["time"][-1])
    end = longest["time"][-1]
    for (series,), of, line in of_all(variants, "{}"):
        shown = series["time"] <= (end * (1 + SAME) if of == "truth" else np.inf)
        energy.plot(series["time"][shown] / turnover, series["energy"][shown] / truth["energy"][0], **line)
        if "density_rms" in series and "density_rms" in truth:
            density.plot(series["time"][shown] / turnover, series["density_rms"][shown], **line)
    for each in variants:
        errors = each.tables["errors"]
        for axis, column in ((error, "velocity_error"), (velocity, "velocity_kl"), (acceleration, "acceleration_kl")):
            axis.plot(errors["time"] / turnover, errors[column], **each.line(errors))
    energy.plot([], [], color=GUIDE, linestyle="--", label="no force, exact")
    error.plot(longest["time"] / turnover, longest["no_force"], color=GUIDE, linestyle="--")
    error.axhline(1, color=GUIDE, linestyle=":", linewidth=1.2)
    error.set(title="Velocity error", ylabel="normalised L2 by particle", ylim=(0, None))
    energy.set(title="Kinetic energy", ylabel="$E(t)/E(0)$", ylim=(0, None))
    density.set(title="Density fluctuation", ylabel=r"$\rho_{rms}/\rho_0$", ylim=(0, None))
    velocity.set(title="Velocity PDF", ylabel="KL divergence (nats)", ylim=(0, None))
    acceleration.set(title="Acceleration PDF", ylabel="KL divergence (nats)", yscale="log")
    unused.remove()
    if not density.lines:
        density.remove()
    for axis in figure.axes:
        axis.set(xlabel="time $t/T$", xlim=(0, end / turnover or None))  # a single frame is at time 0
    legend_at_foot(figure, energy)
    letter(figure.axes)
    return figure


@styled
def particle_pdfs(variants: Variants) -> Figure:
    """Draw the PDFs of velocity and acceleration at times after the start. All three components count in one PDF."""
    times = after_start(variants[0].tables["velocity_pdfs"]["time"])
    figure, axes = panels(2, len(times), (3.5, 2.7), sharex="row", sharey="row")
    for row, (quantity, edges) in zip(axes, EDGES.items()):
        centres, width = bin_centres(edges), np.diff(edges)
        for axis, time in zip(row, times):
            axis.semilogy(centres, gaussian(centres), color=GUIDE, linestyle=":", label="Gaussian")
            for (table,), of, line in of_all(variants, f"{quantity}_pdfs"):
                if (at := row_at(table, time)) is not None:
                    density = table[of][at] / width
                    axis.semilogy(centres, np.where(density > 0, density, np.nan), **{"linewidth": 1.2, **line})
            axis.set_title(f"$t = {time / turnover_of(variants):.2f}\\,T$")
            axis.set_xlabel(f"${quantity[0]}$ / standard deviation of the truth")
        probabilities = variants[0].tables[f"{quantity}_pdfs"]["truth"]
        row[0].set_ylim(0.4 * (probabilities[probabilities > 0].min() / width[0]), 2)
        row[0].set_ylabel(f"{quantity} PDF")
        note(row[0], OUTER_BINS, (0, 1), "axes fraction", (3, -10), fontsize=8)
    legend_at_foot(figure, axes[0, 0])
    letter(axes.flat)
    return figure


@styled
def energy_spectra(variants: Variants) -> Figure:
    """Draw spectra of the variants and the true tracers at several times, each with the DNS spectra of the nearest
    stored time, and below them the ratios of the variants to the true tracers."""
    truth, flow = variants[0].tables["spectra"], variants[0].tables["flow_spectra"]
    cutoff, times, known = np.pi / variants[0].numbers["filter_width"], truth["time"], flow["wavenumber"] >= 1
    figure, axes = panels(2, len(times), (3.5, 2.9) if len(times) > 1 else (5.6, 3.2), sharex=True, sharey="row")
    for number, (axis, ratio, time) in enumerate(zip(*axes, times)):
        for column, line in (("energy_flow", {"color": DNS, "linewidth": 1, "linestyle": ":", "label": "DNS"}),
                             ("energy_filtered", {"color": FILTERED, "linewidth": 1.3, "linestyle": "--",
                                                  "label": "filtered DNS"})):
            axis.loglog(flow["wavenumber"][known], flow[column][number][known], **line)
        for (table,), of, line in of_all(variants, "spectra"):
            if (at := row_at(table, time)) is not None:
                energy, true = table[f"energy_{of}"][at][1:], truth["energy_truth"][number][1:]
                shells = np.arange(1, len(energy) + 1)
                axis.loglog(shells, energy, **{"linewidth": 1.1, **line})
                ratio.loglog(shells, energy / np.where(true > 0, true, np.nan), **{"linewidth": 1.1, **line})
        mark_cutoff(axis, cutoff)
        mark_cutoff(ratio, cutoff)
        axis.set(title=f"$t = {time / turnover_of(variants):.2f}\\,T$")
        ratio.set(xlabel="wavenumber $k$")
        number_wavenumbers(ratio)
    peak, top = truth["energy_truth"][:, 1:].max(), 1.5 * truth["energy_truth"].shape[1]
    guide_power_law(axes[0, 0], (2, min(10, 0.7 * top)), 2.2 * peak, -5 / 3, r"$k^{-5/3}$")
    axes[0, 0].set(ylabel="$E(k)$", ylim=(1e-6 * peak, 6 * peak), xlim=(0.9, max(top, 2)))
    axes[1, 0].set(ylabel="$E(k)$ / true tracers", ylim=(0.2, 5))
    plain_log_ticks(axes[1, 0].yaxis)
    legend_at_foot(figure, axes[0, 0])
    letter(axes.flat)
    return figure


@styled
def path_statistics(variants: Variants) -> Figure:
    """Draw statistics of velocity and acceleration along paths, pair dispersion, and the size and shape of tetrads."""
    figure, axes = panels(3, 3, (3.6, 2.6))
    (memory, structure, accelerations), (variance, flatness, pairs), (sizes, shapes, unused) = axes
    for (paths, increments), _, line in of_all(variants, "paths_{}", "increments_{}"):
        time, lags = paths["time"] / turnover_of(variants), increments["lag"] / turnover_of(variants)
        memory.plot(time, paths["velocity_correlation"], **line)
        structure.loglog(lags, increments["structure"], **line)
        accelerations.plot(lags, increments["acceleration_correlation"], **line)
        variance.plot(time, paths["acceleration_variance"], **line)
        flatness.semilogx(lags, increments["flatness"], **line)
        pairs.loglog(time[1:], paths["pair_dispersion"][1:], **line)
        sizes.plot(time, paths["tetrad_size"], **line)
        for eigenvalue in paths["tetrad_shape"].T:
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
def particle_disorder(variants: Variants) -> Figure:
    """Draw the PDF of nearest-neighbour distances, and the variance of particle counts over time."""
    figure, ((nearest, variance),) = panels(1, 2, (4.4, 3.1))
    edges = disorder.DISTANCE_EDGES
    fine, centres = np.linspace(edges[0], edges[-1], 300), bin_centres(edges)
    nearest.plot(fine, disorder.random_distance_density(fine), color=GUIDE, linestyle=":", label="random points")
    for (distances, series), of, line in of_all(variants, "distances", "{}"):
        nearest.plot(centres, distances[of] / np.diff(edges), **line)
        variance.plot(series["time"] / turnover_of(variants), series["count_variance"], **line)
    nearest.set(title="Nearest neighbour", xlabel="distance / mean spacing", ylabel="PDF", ylim=(0, None))
    variance.axhline(1, color=GUIDE, linestyle=":")
    variance.set(title="Variance of counts", ylabel="relative to random points", xlabel="time $t/T$", ylim=(0, None))
    legend_at_foot(figure, nearest)
    letter((nearest, variance))
    return figure


@styled
def invariant_planes(variants: Variants) -> Figure:
    """Draw joint PDFs of (R, Q) of the truth and of each variant and, if there are several frames, below them the mean
    (dR/dt, dQ/dt) at each (R, Q).

    The mean is drawn as an arrow, whose colour shows the magnitude. For the direction of the arrow, each rate is
    divided by the range of its axis. For the magnitude, each rate is in its own unit, which is a power of <Q_w>.
    """
    first = variants[0].tables["invariants"]
    moving = all("invariant_rates" in each.tables for each in variants)
    wide = 1 + len(variants)
    figure, axes = panels(1 + moving, wide, (2.5 + 2.4 / wide, 3.0), right=BAR + 0.1, sharex=True, sharey=True)
    across, up = first["third"][-2], first["second"][-2]
    # Two to eight contour levels, half a decade apart. The highest is just below the peak of the truth. If there are
    # more than two, the lowest is above the density of one particle.
    peak, single = (np.log10(extreme) for extreme in (first["truth"].max(), first["truth"][first["truth"] > 0].min()))
    top = np.floor(2 * peak)
    levels = 10.0 ** (np.arange(top, min(2 * single, top - 1.5), -1)[:8][::-1] / 2)
    for axis, ((table,), of, line) in zip(axes[0], of_all(variants, "invariants")):
        # Each variant has its own cells, because its last time may be another one. Outer cells are not drawn, because
        # they also count all values beyond them. Empty cells get a value above 0.
        filled = axis.contourf(table["third"][1:-1], table["second"][1:-1],
                               np.maximum(table[of][1:-1, 1:-1], 1e-3 * levels[0]), levels, cmap="YlGnBu",
                               norm=LogNorm(levels[0], levels[-1]), extend="max")
        axis.set_title(line["label"])
    bar = colour_bar(figure, filled, axes[0], "joint PDF", extend="neither")
    bar.set_ticks(levels[::2], labels=[f"{level:.0e}" for level in levels[::2]])
    if moving:
        flows = [(table, of) for (table,), of, _ in of_all(variants, "invariant_rates")]
        speeds = np.concatenate([np.hypot(table[f"second_rate_{of}"], table[f"third_rate_{of}"]).ravel()
                                 for table, of in flows])
        speeds = speeds[speeds > 0]
        norm = LogNorm(*np.quantile(speeds, (0.02, 0.98))) if speeds.size else None
        for axis, flow in zip(axes[1], flows):
            arrows = _draw_arrows(axis, *flow, norm, 0.97 * across, 0.97 * up)
        bar = colour_bar(figure, arrows, axes[1], "speed of the mean motion")
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
    return figure


def _draw_arrows(axis: Axes, table: Table, of: str, norm: LogNorm | None, third_limit: float, second_limit: float):
    """Draw arrows of equal length at the cells with |R| < `third_limit` and |Q| < `second_limit`, and return them.

    With these limits no arrow leaves the panel.
    """
    third, second = np.meshgrid(table["third"], table["second"])
    inside = (np.abs(third) < third_limit) & (np.abs(second) < second_limit)
    second_rate, third_rate = (table[f"{name}_rate_{of}"][inside] for name in ("second", "third"))
    across, up = third_rate / np.ptp(third), second_rate / np.ptp(second)
    length = np.hypot(across, up)
    length[length == 0] = np.nan
    return axis.quiver(third[inside], second[inside], across / length, up / length, np.hypot(second_rate, third_rate),
                       norm=norm, cmap="cividis", pivot="middle", scale=20, width=0.006, headwidth=4)


@styled
def forced_rollouts(variants: Variants) -> Figure:
    """Draw energy over time, mean spectra and acceleration PDFs of forced rollouts and of the stationary flow."""
    flow, truth = variants[0].numbers["forced"]["energy"], variants[0].tables["forced_spectra"]
    mean, deviation = flow["stationary flow"], flow["its deviation"]
    cutoff = np.pi / variants[0].numbers["filter_width"]
    figure, ((energy, spectrum, density),) = panels(1, 3, (3.6, 3.1))
    energy.axhspan(mean - deviation, mean + deviation, color=TRUTH, alpha=0.15, linewidth=0)
    energy.axhline(mean, **WIDE, label="stationary flow")
    energy.plot([], [], color=GUIDE, linestyle="--", label="Gaussian")
    spectrum.loglog(truth["wavenumber"], truth["energy_flow"], **WIDE)
    edges = EDGES["acceleration"]
    middle, highest = bin_centres(edges), mean + deviation
    density.semilogy(middle, gaussian(middle), color=GUIDE, linestyle="--", linewidth=1.1)
    for (accelerations,), of, line in of_all(variants, "forced_accelerations"):
        found = accelerations[of] / np.diff(edges)
        density.plot(middle[found > 0], found[found > 0], **line)
    for each in variants:
        model, spectra = each.tables["model"], each.tables["forced_spectra"]
        energy.plot(model["time"] / turnover_of(variants), model["energy"], **each.line(model))
        spectrum.loglog(spectra["wavenumber"], spectra["energy_model"], **each.line(spectra))
        highest = max(highest, model["energy"].max())
    energy.set(title="Kinetic energy", xlabel="$t/T$", ylabel=r"$\langle v\cdot v\rangle/2$", ylim=(0, 1.15 * highest))
    drawn = truth["energy_flow"][(truth["wavenumber"] >= 1) & (truth["wavenumber"] <= 2 * cutoff)]
    mark_cutoff(spectrum, cutoff)
    spectrum.set(title="Mean spectrum", xlabel="$k$", ylabel="$E(k)$", xlim=(0.9, 2 * cutoff),
                 ylim=(drawn.min() / 3, 3 * drawn.max()))
    number_wavenumbers(spectrum)
    density.set(title="Acceleration PDF", xlabel="$a$ / its standard deviation", ylim=(1e-6, 1))
    legend_at_foot(figure, energy)
    letter((energy, spectrum, density))
    return figure
