"""Figures of a rollout and the true tracers: fields (the paper's Figs. 4-5), spectra (8), errors in time."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eddies.analysis.against_truth import Pair, SpectraAt
from eddies.report.figures import (DNS, FILTERED, FOURTH, GUIDE, MODEL, POSITIVE, SIGNED, TRUTH, colour_bar,
                                   guide_power_law, largest, letter, number_wavenumbers, panels, show_plane, styled)

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
def energy_spectra(series: Sequence[SpectraAt], eulerian: Mapping[str, np.ndarray] | None, start_time: float,
                   turnover: float, filter_wavenumber: float | None) -> Figure:
    """Reconstructed spectra of model and true tracers over time with those of the DNS at the nearest time.

    `eulerian`: table with time (m,), wavenumber (k,), energy and filtered (m, k); model times count from
    start_time.
    """
    figure, axes = panels(1, len(series), (3.6, 3.5), sharex=True, sharey=True)
    for axis, at in zip(axes.flat, series):
        if eulerian is not None:
            _eulerian_lines(axis, eulerian, start_time + at.time)
        shells = at.wavenumber >= 1
        axis.loglog(at.wavenumber[shells], at.truth[shells], color=TRUTH, label="true tracers")
        axis.loglog(at.wavenumber[shells], at.model[shells], color=MODEL, linestyle="none", marker="o",
                    markersize=4, markerfacecolor="none", label="model")
        if filter_wavenumber is not None:
            axis.axvline(filter_wavenumber, color=GUIDE, linestyle=":", linewidth=1)
            axis.annotate(r"$\pi/d$", (filter_wavenumber, 0.01), xycoords=("data", "axes fraction"),
                          xytext=(3, 1), textcoords="offset points", fontsize=9, color="#5a5a5a")
        axis.set(title=f"$t = {at.time / turnover:.2f}\\,T$", xlabel="wavenumber $k$")
        number_wavenumbers(axis)
    peak = max(at.truth[1:].max() for at in series)
    top = series[0].wavenumber.size / np.sqrt(3)
    guide_power_law(axes[0, 0], (2, min(10, 0.7 * top)), 2.2 * peak, -5 / 3, r"$k^{-5/3}$")
    axes[0, 0].set(ylabel="$E(k)$", ylim=(1e-6 * peak, 6 * peak), xlim=(0.9, top))
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncol=4)
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
    error.plot(errors["time"] / turnover, errors["velocity_error"], color=MODEL)
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
def lagrangian(series: Mapping[str, Mapping[str, np.ndarray]], turnover: float) -> Figure:
    """Velocity autocorrelation and pair dispersion of true tracers and model over time.

    series: "truth" and "model", each with time, correlation, and dispersion in units of the initial
    separation.
    """
    figure, axes = panels(1, 2, (4.2, 3.1))
    for name, line in LINES.items():
        time = series[name]["time"] / turnover
        axes[0, 0].plot(time, series[name]["correlation"], **line)
        axes[0, 1].plot(time, series[name]["dispersion"], **line)
    axes[0, 0].set(title="Velocity autocorrelation", ylabel=r"$\rho_L(t)$")
    axes[0, 1].set(title="Pair dispersion", ylabel=r"$\langle|r(t)-r(0)|^2\rangle\,/\,\langle r(0)^2\rangle$")
    for axis in axes.flat:
        axis.set_xlabel("time $t/T$")
    axes[0, 0].legend()
    letter(axes.flat)
    return figure


def _eulerian_lines(axis: Axes, eulerian: Mapping[str, np.ndarray], time: float) -> None:
    nearest = int(np.argmin(np.abs(eulerian["time"] - time)))
    shells = eulerian["wavenumber"] >= 1
    k = eulerian["wavenumber"][shells]
    axis.loglog(k, eulerian["energy"][nearest][shells], color=DNS, linewidth=1.3, label="DNS")
    axis.loglog(k, eulerian["filtered"][nearest][shells], color=FILTERED, linestyle="--", linewidth=1.3,
                label="filtered DNS")
