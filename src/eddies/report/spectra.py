"""Energy spectra of a rollout (the paper's Fig. 8): one figure and its numbers."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eddies.analysis.rollout import Rollout, SpectraAt
from eddies.report.figures import (DNS, FILTERED, GUIDE, MODEL, TRUTH, guide_power_law, letter, number_wavenumbers,
                                   panels, styled)
from eddies.report.page import Metric, Section


def add(shown: Section, run: Rollout) -> None:
    """Put the figure and the numbers, at the last common time at which the flow's spectrum is known, into the section
    of the rollout."""
    cutoff, series = run.filter_wavenumber, [run.spectra_at(index) for index in run.shown_spectra()]
    last = series[-1]
    errors = {name: last.error(name, cutoff) for name in ("model", "truth")}
    shown.metrics += [
        Metric("filter_wavenumber", "filter wavenumber k_d = π/d", cutoff),
        Metric("spectrum_error", "spectrum error, rms of ln(E/E_filtered) over 1 ≤ k ≤ k_d", errors["model"]),
        Metric("spectrum_error_floor", "the same of the true tracers, found alike", errors["truth"]),
        Metric("band_energy_ratios", "energy of bands of wavenumbers, model / filtered flow",
               last.bands("model", cutoff)),
        Metric("band_energy_ratios_floor", "the same of the true tracers", last.bands("truth", cutoff)),
    ]
    shown.add_figure(
        "figure-8-spectra", "Energy spectra over time (the paper's Fig. 8)",
        energy_spectra(series, run.flow, run.start_time, run.turnover, cutoff),
        "Of the solenoidal modes that least squares find in the velocities of the model's particles and, alike, of the "
        f"true tracers; black and grey: the DNS itself. Rms of ln(E/E_filtered) at t = {last.time / run.turnover:.2f} "
        f"T up to k_d = π/d = {cutoff:.3g}: model {errors['model']:.3f}, true tracers {errors['truth']:.3f}.")


@styled
def energy_spectra(series: Sequence[SpectraAt], flow: Mapping[str, np.ndarray], start_time: float, turnover: float,
                   filter_wavenumber: float) -> Figure:
    """Spectra of model and true tracers over time with those of the DNS at the nearest time.

    `flow`: table with time (m,), wavenumber (k,), energy and filtered (m, k); model times count from
    start_time.
    """
    figure, axes = panels(1, len(series), (3.6, 3.5), sharex=True, sharey=True)
    for axis, at in zip(axes.flat, series):
        _flow_lines(axis, flow, start_time + at.time)
        shells = at.wavenumber >= 1
        axis.loglog(at.wavenumber[shells], at.truth[shells], color=TRUTH, label="true tracers")
        axis.loglog(at.wavenumber[shells], at.model[shells], color=MODEL, linestyle="none", marker="o",
                    markersize=4, markerfacecolor="none", label="model")
        axis.axvline(filter_wavenumber, color=GUIDE, linestyle=":", linewidth=1)
        axis.annotate(r"$\pi/d$", (filter_wavenumber, 0.01), xycoords=("data", "axes fraction"),
                      xytext=(3, 1), textcoords="offset points", fontsize=9, color="#5a5a5a")
        axis.set(title=f"$t = {at.time / turnover:.2f}\\,T$", xlabel="wavenumber $k$")
        number_wavenumbers(axis)
    peak, top = max(at.truth[1:].max() for at in series), 1.5 * series[0].wavenumber[-1]
    guide_power_law(axes[0, 0], (2, min(10, 0.7 * top)), 2.2 * peak, -5 / 3, r"$k^{-5/3}$")
    axes[0, 0].set(ylabel="$E(k)$", ylim=(1e-6 * peak, 6 * peak), xlim=(0.9, max(top, 2)))
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncol=4)
    letter(axes.flat)
    return figure


def _flow_lines(axis: Axes, flow: Mapping[str, np.ndarray], time: float) -> None:
    nearest = int(np.argmin(np.abs(flow["time"] - time)))
    shells = flow["wavenumber"] >= 1
    k = flow["wavenumber"][shells]
    axis.loglog(k, flow["energy"][nearest][shells], color=DNS, linewidth=1.3, label="DNS")
    axis.loglog(k, flow["filtered"][nearest][shells], color=FILTERED, linestyle="--", linewidth=1.3,
                label="filtered DNS")
