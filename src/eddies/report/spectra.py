"""Energy spectra of a rollout (the paper's Fig. 8): one figure and its numbers."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eddies.analysis.rollout_spectra import RolloutSpectra, SpectraAt
from eddies.report.figures import (DNS, FILTERED, GUIDE, MODEL, TRUTH, guide_power_law, letter, number_wavenumbers,
                                   panels, styled)
from eddies.report.page import Metric, Section

PANELS = 3
UNKNOWN = "the filtered flow is in ground_truth.h5, which is not here"
LABELS = {
    "spectrum_error": "spectrum error, rms of ln(E/E_filtered) over 1 ≤ k ≤ k_d",
    "spectrum_error_floor": "the same of the true tracers, found alike",
    "band_energy_ratios": "energy of bands of wavenumbers, model / filtered flow",
    "band_energy_ratios_floor": "the same of the true tracers",
}


def add(shown: Section, spectra: RolloutSpectra, until: float, turnover: float, cutoff: float | None) -> None:
    """Put the figure and the numbers, at the last time before `until`, into the section of the rollout; `cutoff` is the
    filter wavenumber k_d, or None."""
    times = spectra.times(until)
    shown.metrics.append(Metric("filter_wavenumber", "filter wavenumber k_d = π/d", cutoff, UNKNOWN))
    chosen = np.unique(np.rint(np.linspace(0, times.size - 1, PANELS)).astype(int))
    series = [spectra.at(time) for time in times[chosen]]
    last = series[-1]
    caption = ("Of the solenoidal modes that least squares find in the velocities of the model's particles and, alike, "
               "of the true tracers; black and grey: the DNS itself.")
    values: dict[str, Any] = dict.fromkeys(LABELS)
    if cutoff is not None and last.filtered is not None:
        values = {"spectrum_error": last.error("model", cutoff), "spectrum_error_floor": last.error("truth", cutoff),
                  "band_energy_ratios": last.bands("model", cutoff),
                  "band_energy_ratios_floor": last.bands("truth", cutoff)}
        caption += (f" Rms of ln(E/E_filtered) at t = {last.time / turnover:.2f} T up to k_d = π/d = {cutoff:.3g}: "
                    f"model {values['spectrum_error']:.3f}, true tracers {values['spectrum_error_floor']:.3f}.")
    shown.metrics += [Metric(key, label, values[key], UNKNOWN) for key, label in LABELS.items()]
    shown.add_figure("figure-8-spectra", "Energy spectra over time (the paper's Fig. 8)",
                     energy_spectra(series, spectra.flow, spectra.start_time, turnover, cutoff), caption)


@styled
def energy_spectra(series: Sequence[SpectraAt], eulerian: Mapping[str, np.ndarray] | None, start_time: float,
                   turnover: float, filter_wavenumber: float | None) -> Figure:
    """Spectra of model and true tracers over time with those of the DNS at the nearest time.

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
    peak, top = max(at.truth[1:].max() for at in series), 1.5 * series[0].wavenumber[-1]
    guide_power_law(axes[0, 0], (2, min(10, 0.7 * top)), 2.2 * peak, -5 / 3, r"$k^{-5/3}$")
    axes[0, 0].set(ylabel="$E(k)$", ylim=(1e-6 * peak, 6 * peak), xlim=(0.9, max(top, 2)))
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncol=4)
    letter(axes.flat)
    return figure


def _eulerian_lines(axis: Axes, eulerian: Mapping[str, np.ndarray], time: float) -> None:
    nearest = int(np.argmin(np.abs(eulerian["time"] - time)))
    shells = eulerian["wavenumber"] >= 1
    k = eulerian["wavenumber"][shells]
    axis.loglog(k, eulerian["energy"][nearest][shells], color=DNS, linewidth=1.3, label="DNS")
    axis.loglog(k, eulerian["filtered"][nearest][shells], color=FILTERED, linestyle="--", linewidth=1.3,
                label="filtered DNS")
