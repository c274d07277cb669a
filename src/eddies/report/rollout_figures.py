"""Figures of rollouts beside the true tracers: the paper's Figs. 4 to 9, Lagrangian statistics, disorder.

Each function draws the measures of several variants, by name, and their common truth.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from eddies.analysis import disorder
from eddies.analysis.against_truth import EDGES
from eddies.analysis.pdfs import bin_centres, gaussian
from eddies.analysis.velocity_gradients import ConditionalVelocity, InvariantBins, vieillefosse_line
from eddies.clock import SAME
from eddies.report.figures import (BAR, DNS, FILTERED, GUIDE, MODEL, POSITIVE, SIGNED, TRUTH, Look, colour_bar,
                                   guide_power_law, largest, legend_at_foot, letter, note, number_wavenumbers, panels,
                                   plain_log_ticks, show_plane, styled)

FEWEST = 8  # smallest number of particles in a cell of the Q-R plane for which its mean motion is drawn
WIDE = {"color": TRUTH, "linewidth": 2.2}  # a line of the truth, which is seen beside and behind other lines
TRUE = "true tracers"
Table = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Drawn:
    """A variant in the figures: its label, its colour and marker, and the numbers and tables of its measures."""

    label: str
    look: Look
    numbers: Mapping[str, Any]
    tables: Mapping[str, Table]

    @property
    def turnover(self) -> float:
        """Eddy turnover time T."""
        return float(self.numbers["attributes"]["eddy_turnover_time"])

    def line(self, times: int = 0) -> dict[str, Any]:
        """Return the style of a line through values at `times` times, with about eight markers."""
        colour, marker = self.look
        return {"color": colour, "marker": marker, "markersize": 4, "markevery": max(times // 8, 1),
                "label": self.label}


Variants = Mapping[str, Drawn]


def row_at(table: Table, time: float) -> int | None:
    """Return the row of a table at a time, or None."""
    times = table["time"]
    row = int(np.argmin(np.abs(times - time)))
    return row if abs(times[row] - time) <= SAME * max(times.max(), abs(time), 1e-300) else None


def _legend_columns(variants: Variants, more: int) -> int:
    return min(len(variants) + more, 5)


def _foot(entries: int) -> float:
    """Return the height in inches of a legend with `entries` entries, five in a line."""
    return 0.1 + 0.2 * -(-entries // 5)


@styled
def velocity_planes(variants: Variants) -> Figure:
    """Draw u_x in planes [y, x], with a row of panels for the truth and for each variant, and a column for each time.

    The planes of the truth determine the colour scale. A panel without a frame of the variant is empty.
    """
    first = next(iter(variants.values()))
    truth, turnover = first.tables["planes"], first.turnover
    high, wide = 1 + len(variants), len(truth["time"])
    figure, axes = panels(high, wide, ((2.3 * wide + 1.46) / wide, (2.1 * high + 1.15) / high), right=BAR, sharex=True,
                          sharey=True)
    limit = largest(*(plane[0] for plane in truth["velocity_truth"]))
    rows = [(TRUE, truth, "velocity_truth")]
    rows += [(each.label, each.tables["planes"], "velocity_model") for each in variants.values()]
    for row, (name, table, column) in zip(axes, rows):
        for axis, time in zip(row, truth["time"]):
            if (at := row_at(table, time)) is not None:
                image = show_plane(axis, table[column][at][0], (-limit, limit), SIGNED)
            else:
                axis.set_aspect("equal")
                note(axis, "no frame", (0.5, 0.5), "axes fraction", (0, 0), ha="center")
        row[0].set_ylabel(f"{name}\n$y$")
    for top, last, time in zip(axes[0], axes[-1], truth["time"]):
        top.set_title(f"$t = {time / turnover:.2f}\\,T$")
        last.set_xlabel("$x$")
    colour_bar(figure, image, axes.flat, "$u_x$")
    return figure


@styled
def vorticity_and_energy(variants: Variants) -> Figure:
    """Draw planes [y, x] of the vorticity magnitude, and below them of the kinetic energy, at the last time of each
    variant. The truth has the first column of panels, and determines the colour scales."""
    first = next(iter(variants.values())).tables["planes"]
    columns = {TRUE: (first["vorticity_truth"][-1], first["velocity_truth"][-1])}
    columns |= {each.label: (each.tables["planes"]["vorticity_model"][-1], each.tables["planes"]["velocity_model"][-1])
                for each in variants.values()}
    figure, axes = panels(2, len(columns), (2.1 + 2.1 / len(columns), 2.9), right=BAR, sharex=True, sharey=True)
    vorticity, energy = zip(*((strength, kinetic_energy(velocity)) for strength, velocity in columns.values()))
    for row, label, planes in zip(axes, (r"$|\omega|$", r"$\frac{1}{2}|u|^2$"), (vorticity, energy)):
        for axis, values in zip(row, planes):
            image = show_plane(axis, values, (0, largest(planes[0])), POSITIVE)
        colour_bar(figure, image, row, label, extend="max")
        row[0].set_ylabel("$y$")
    for top, last, name in zip(*axes, columns):
        top.set_title(name)
        last.set_xlabel("$x$")
    return figure


def kinetic_energy(velocity: np.ndarray) -> np.ndarray:
    """Return |u|^2 / 2 of a velocity (3, y, x), as an array [y, x]."""
    return np.sum(velocity**2, axis=0) / 2


@styled
def errors_over_time(variants: Variants) -> Figure:
    """Draw velocity error, energy, density rms if there is a density, and divergences of PDFs over time."""
    first = next(iter(variants.values()))
    truth, turnover = first.tables["truth"], first.turnover
    figure, axes = panels(2, 3, (3.6, 2.7), foot=_foot(len(variants) + 2))
    error, energy, density, velocity, acceleration, unused = axes.flat
    end = max(each.tables["errors"]["time"][-1] for each in variants.values())
    seen = truth["time"] <= end * (1 + SAME)
    energy.plot(truth["time"][seen] / turnover, truth["energy"][seen] / truth["energy"][0], **WIDE)
    if "density_rms" in truth:
        density.plot(truth["time"][seen] / turnover, truth["density_rms"][seen], **WIDE)
    error.plot([], [], **WIDE, label=TRUE)
    for each in variants.values():
        model, errors = each.tables["model"], each.tables["errors"]
        time, at = errors["time"] / turnover, model["time"] / turnover
        error.plot(time, errors["velocity_error"], **each.line(len(time)))
        energy.plot(at, model["energy"] / truth["energy"][0], **each.line(len(at)))
        if "density_rms" in model and density.lines:
            density.plot(at, model["density_rms"], **each.line(len(at)))
        for axis, column in ((velocity, "velocity_kl"), (acceleration, "acceleration_kl")):
            axis.plot(time, errors[column], **each.line(len(time)))
    longest = max((each.tables["errors"] for each in variants.values()), key=lambda errors: errors["time"][-1])
    error.plot(longest["time"] / turnover, longest["no_force"], color=GUIDE, linestyle="--", label="no force, exact")
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
    legend_at_foot(figure, error, _legend_columns(variants, 2))
    letter(figure.axes)
    return figure


@styled
def particle_pdfs(variants: Variants) -> Figure:
    """Draw the PDFs of velocity and acceleration at several times. All three components count in one PDF."""
    first = next(iter(variants.values()))
    truth = first.tables["pdfs"]
    figure, axes = panels(2, len(truth["time"]), (3.5, 2.7), foot=_foot(len(variants) + 2), sharex="row", sharey="row")
    for row, (quantity, edges) in zip(axes, EDGES.items()):
        centres, width = bin_centres(edges), np.diff(edges)
        for axis, time in zip(row, truth["time"]):
            axis.semilogy(centres, gaussian(centres), color=GUIDE, linestyle=":", label="Gaussian")
            lines = [(truth, f"{quantity}_truth", {**WIDE, "label": TRUE})]
            lines += [(each.tables["pdfs"], f"{quantity}_model", each.line(len(centres))) for each in variants.values()]
            for table, column, line in lines:
                if (at := row_at(table, time)) is not None:
                    density = table[column][at] / width
                    axis.semilogy(centres, np.where(density > 0, density, np.nan), **{"linewidth": 1.2, **line})
            axis.set_title(f"$t = {time / first.turnover:.2f}\\,T$")
            axis.set_xlabel(f"${quantity[0]}$ / standard deviation of the truth")
        probabilities = truth[f"{quantity}_truth"]
        row[0].set_ylim(0.4 * (probabilities[probabilities > 0].min() / width[0]), 2)
        row[0].set_ylabel(f"{quantity} PDF")
    legend_at_foot(figure, axes[0, 0], _legend_columns(variants, 2))
    letter(axes.flat)
    return figure


@styled
def energy_spectra(variants: Variants) -> Figure:
    """Draw spectra of the variants and the true tracers at several times, each with the DNS spectra of the nearest
    stored time."""
    first = next(iter(variants.values()))
    truth, flow, cutoff = first.tables["spectra"], first.tables["flow_spectra"], first.numbers["rollout"][
        "filter_wavenumber"]
    times = truth["time"]
    figure, axes = panels(1, len(times), (3.5, 3.4) if len(times) > 1 else (5.6, 3.8), foot=_foot(len(variants) + 3),
                          sharex=True, sharey=True)
    known, shells = flow["wavenumber"] >= 1, np.arange(1, truth["truth"].shape[1])
    for number, (axis, time) in enumerate(zip(axes.flat, times)):
        axis.loglog(flow["wavenumber"][known], flow["energy"][number][known], color=DNS, linewidth=1, linestyle=":",
                    label="DNS")
        axis.loglog(flow["wavenumber"][known], flow["filtered"][number][known], color=FILTERED, linestyle="--",
                    linewidth=1.3, label="filtered DNS")
        axis.loglog(shells, truth["truth"][number][1:], **WIDE, label=TRUE)
        for each in variants.values():
            table = each.tables["spectra"]
            if (at := row_at(table, time)) is not None:
                energy = table["model"][at][1:]
                axis.loglog(np.arange(1, len(energy) + 1), energy, **{**each.line(), "linewidth": 1.1})
        axis.axvline(cutoff, color=GUIDE, linestyle=":", linewidth=1)
        note(axis, r"$\pi/d$", (cutoff, 0.01), ("data", "axes fraction"), (3, 1))
        axis.set(title=f"$t = {time / first.turnover:.2f}\\,T$", xlabel="wavenumber $k$")
        number_wavenumbers(axis)
    peak, top = truth["truth"][:, 1:].max(), 1.5 * truth["truth"].shape[1]
    guide_power_law(axes[0, 0], (2, min(10, 0.7 * top)), 2.2 * peak, -5 / 3, r"$k^{-5/3}$")
    axes[0, 0].set(ylabel="$E(k)$", ylim=(1e-6 * peak, 6 * peak), xlim=(0.9, max(top, 2)))
    legend_at_foot(figure, axes[0, 0], _legend_columns(variants, 3))
    letter(axes.flat)
    return figure


@styled
def path_statistics(variants: Variants) -> Figure:
    """Draw statistics of velocity and acceleration along paths, pair dispersion, and the size and shape of tetrads."""
    figure, axes = panels(3, 3, (3.6, 2.6))
    (memory, structure, accelerations), (variance, flatness, pairs), (sizes, shapes, unused) = axes
    first = next(iter(variants.values()))
    lines = [(first.tables["paths_truth"], {**WIDE, "label": TRUE})]
    lines += [(each.tables["paths_model"], each.line(len(each.tables["paths_model"]["times"])))
              for each in variants.values()]
    for run, line in lines:
        time, lags = run["times"] / first.turnover, run["lags"] / first.turnover
        memory.plot(time, run["velocity_correlation"], **line)
        structure.loglog(lags, run["structure"], **line)
        accelerations.plot(lags, run["acceleration_correlation"], **line)
        variance.plot(time, run["acceleration_variance"], **line)
        flatness.semilogx(lags, run["flatness"], **line)
        pairs.loglog(time[1:], run["pair_dispersion"][1:], **line)
        sizes.plot(time, run["tetrad_size"], **line)
        for eigenvalue in run["tetrad_shape"].T:
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
    figure, ((nearest, variance),) = panels(1, 2, (4.4, 3.1), foot=_foot(len(variants) + 2))
    edges, first = disorder.DISTANCE_EDGES, next(iter(variants.values()))
    fine, centres = np.linspace(edges[0], edges[-1], 300), bin_centres(edges)
    nearest.plot(fine, disorder.random_distance_density(fine), color=GUIDE, linestyle=":", label="random points")
    lines = [(first.tables["distances"]["truth"], first.tables["truth"], {**WIDE, "label": TRUE})]
    lines += [(each.tables["distances"]["model"], each.tables["model"], each.line(len(centres)))
              for each in variants.values()]
    for distances, series, line in lines:
        nearest.plot(centres, distances / np.diff(edges), **line)
        variance.plot(series["time"] / first.turnover, series["count_variance"], **{**line, "markevery": 1})
    nearest.set(title="Nearest neighbour", xlabel="distance / mean spacing", ylabel="PDF", ylim=(0, None))
    variance.axhline(1, color=GUIDE, linestyle=":")
    variance.set(title="Variance of counts", ylabel="relative to random points", xlabel="time $t/T$", ylim=(0, None))
    legend_at_foot(figure, nearest, _legend_columns(variants, 2))
    letter((nearest, variance))
    return figure


@styled
def invariant_planes(variants: Variants) -> Figure:
    """Draw joint PDFs of (R, Q) of the truth and of each variant and, if there are several frames, below them the mean
    (dR/dt, dQ/dt) at each (R, Q).

    The mean is drawn as an arrow, whose colour shows the magnitude. For the direction of the arrow, each rate is
    divided by the range of its axis. For the magnitude, each rate is in its own unit, which is a power of <Q_w>.
    """
    first = next(iter(variants.values())).tables
    bins = InvariantBins(first["invariants"]["second"], first["invariants"]["third"])
    columns = {TRUE: (first, "truth"), **{each.label: (each.tables, "model") for each in variants.values()}}
    moving = all("invariant_rates" in tables for tables, _ in columns.values())
    figure, axes = panels(1 + moving, len(columns), (2.5 + 2.4 / len(columns), 3.0), right=BAR + 0.1, sharex=True,
                          sharey=True)
    across, up = bin_centres(bins.third)[-2], bin_centres(bins.second)[-2]
    truth = bins.density(first["invariants"]["truth"])
    # Two to eight contour levels, half a decade apart. The highest is just below the peak of the truth. If there are
    # more than two, the lowest is above the density of one particle.
    peak, single = (np.log10(extreme) for extreme in (truth.max(), truth[truth > 0].min()))
    top = np.floor(2 * peak)
    levels = 10.0 ** (np.arange(top, min(2 * single, top - 1.5), -1)[:8][::-1] / 2)
    for axis, (name, (tables, of)) in zip(axes[0], columns.items()):
        # Each variant has its own bins, because its last time may be another one. Outer cells are not drawn, because
        # they also count all values beyond them. Empty cells get a value above 0.
        own = InvariantBins(tables["invariants"]["second"], tables["invariants"]["third"])
        shown = np.maximum(own.density(tables["invariants"][of])[1:-1, 1:-1], 1e-3 * levels[0])
        filled = axis.contourf(bin_centres(own.third)[1:-1], bin_centres(own.second)[1:-1], shown, levels,
                               cmap="YlGnBu", norm=LogNorm(levels[0], levels[-1]), extend="max")
        axis.set_title(name)
    bar = colour_bar(figure, filled, axes[0], "joint PDF", extend="neither")
    bar.set_ticks(levels[::2], labels=[f"{level:.0e}" for level in levels[::2]])
    if moving:
        flows = [rates(tables["invariant_rates"], of) for tables, of in columns.values()]
        speeds = np.concatenate([np.hypot(*flow.mean(FEWEST)).ravel() for flow in flows])
        speeds = speeds[speeds > 0]
        norm = LogNorm(*np.quantile(speeds, (0.02, 0.98))) if speeds.size else None
        for axis, flow in zip(axes[1], flows):
            arrows = _draw_arrows(axis, flow, norm, 0.97 * across, 0.97 * up)
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


def rates(table: Table, of: str) -> ConditionalVelocity:
    """Return the mean motion in the Q-R plane of "model" or "truth" from its table."""
    found = ConditionalVelocity(InvariantBins(table["second"], table["third"]))
    for name in ConditionalVelocity.SUMS:
        setattr(found, name, table[f"{name}_{of}"])
    return found


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


@styled
def forced_rollouts(variants: Variants) -> Figure:
    """Draw energy over time, mean spectra and acceleration PDFs of forced rollouts and of the stationary flow."""
    first = next(iter(variants.values()))
    flow = first.numbers["forced"]["energy"]
    mean, deviation = flow["stationary flow"], flow["its deviation"]
    cutoff, truth = np.pi / first.numbers["filter_width"], first.tables["forced_spectra"]
    figure, ((energy, spectrum, density),) = panels(1, 3, (3.6, 3.1), foot=_foot(len(variants) + 2))
    energy.axhspan(mean - deviation, mean + deviation, color=TRUTH, alpha=0.15, linewidth=0)
    energy.axhline(mean, **WIDE, label="stationary flow")
    spectrum.loglog(truth["wavenumber"], truth["flow"], **WIDE)
    edges = EDGES["acceleration"]
    middle, width, highest = bin_centres(edges), np.diff(edges), mean + deviation
    density.semilogy(middle, gaussian(middle), color=GUIDE, linestyle="--", linewidth=1.1)
    energy.plot([], [], color=GUIDE, linestyle="--", label="Gaussian")
    true = first.tables["forced_accelerations"]["truth"] / width
    density.plot(middle[true > 0], true[true > 0], **WIDE)
    for each in variants.values():
        model, spectra = each.tables["model"], each.tables["forced_spectra"]
        energy.plot(model["time"] / each.turnover, model["energy"], **each.line(len(model["time"])))
        spectrum.loglog(spectra["wavenumber"], spectra["model"], **each.line())
        found = each.tables["forced_accelerations"]["model"] / width
        density.plot(middle[found > 0], found[found > 0], **each.line(len(middle)))
        highest = max(highest, model["energy"].max())
    energy.set(title="Kinetic energy", xlabel="$t/T$", ylabel=r"$\langle v\cdot v\rangle/2$", ylim=(0, 1.15 * highest))
    drawn = (truth["wavenumber"] >= 1) & (truth["wavenumber"] <= 2 * cutoff)
    spectrum.axvline(cutoff, color=GUIDE, linestyle=":")
    spectrum.set(title="Mean spectrum", xlabel="$k$", ylabel="$E(k)$", xlim=(0.9, 2 * cutoff),
                 ylim=(truth["flow"][drawn].min() / 3, 3 * truth["flow"][drawn].max()))
    number_wavenumbers(spectrum)
    density.set(title="Acceleration PDF", xlabel="$a$ / its standard deviation", ylim=(1e-6, 1))
    legend_at_foot(figure, energy, _legend_columns(variants, 2))
    letter((energy, spectrum, density))
    return figure
