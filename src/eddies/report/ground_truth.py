"""Figures of the ground truth: the history of its statistics and its energy spectra."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eddies.report.figures import (DNS, FILTERED, FOURTH, GUIDE, MODEL, POSITIVE, SECOND, SIGNED, TRUTH, colour_bar,
                                   guide_power_law, largest, legend_below, letter, mark_time, number_wavenumbers,
                                   panels, show_plane, styled)
from eddies.report.page import Metric, Section
from eddies.spectral.mode_operators import gaussian_transfer

# Panels of the history: title, axis label, and the columns with their labels, colours and line styles.
HISTORY = (
    ("Kinetic energy", r"$\frac{1}{2}\langle u\cdot u\rangle$", (("energy", None, DNS, "-"),)),
    ("Dissipation", "energy rate", (
        ("dissipation_rate", r"dissipation $\varepsilon$", TRUTH, "-"),
        ("injection_rate", "injection", FOURTH, "--"))),
    ("Taylor Reynolds number", r"$Re_\lambda$", (("reynolds_lambda", None, DNS, "-"),)),
    ("Resolution", r"$k_{\max}\,\eta$", (("kmax_eta", None, DNS, "-"),)),
    ("Compressibility", "fraction", (
        ("mach_turbulent", r"$M_t$", TRUTH, "-"),
        ("density_rms", r"$\rho_{rms}/\rho_0$", MODEL, "--"),
        ("compressible_fraction", "energy fraction", SECOND, "-."))),
    ("Longitudinal gradient", "moment", (
        ("skewness", "skewness", TRUTH, "-"),
        ("flatness", "flatness", MODEL, "--"))),
)

LOGARITHMIC, SMALLEST = ("Compressibility",), 1e-8  # below it is rounding, which would stretch the axis
METRICS = {
    "reynolds_lambda": "Taylor Reynolds number Re_λ", "kmax_eta": "resolution k_max η",
    "mach_turbulent": "turbulent Mach number M_t",
    "energy_budget_error": "relative error of the energy budget",
    "skewness": "skewness of the longitudinal gradient", "flatness": "flatness of the longitudinal gradient",
    "energy": "kinetic energy", "dissipation_rate": "dissipation rate ε", "integral_scale": "integral scale",
    "eddy_turnover_time": "eddy turnover time T", "kolmogorov_time": "Kolmogorov time",
    "density_rms": "density rms", "filter_width": "filter width d", "spacing": "mean particle spacing",
    "velocity_rms": "velocity rms of the tracers", "acceleration_rms": "acceleration rms of the tracers",
}


@styled
def statistics_history(statistics: Mapping[str, np.ndarray], release: float | None) -> Figure:
    """Energy, dissipation, Re_lambda and further columns over time; `release` is when the tracers start, if
    they do.

    Columns (samples,); panels and lines without one finite number are left out.
    """
    shown = [panel for panel in HISTORY if any(_known(statistics, line[0]) for line in panel[2])]
    rows = -(-len(shown) // 3)
    figure, axes = panels(rows, 3, (3.5, 2.6))
    for axis, (title, label, lines) in zip(axes.flat, shown):
        lines = [line for line in lines if _known(statistics, line[0])]
        for column, name, colour, style in lines:
            values = statistics[column]
            if title in LOGARITHMIC:
                values = np.where(values > SMALLEST, values, np.nan)
            axis.plot(statistics["time"], values, color=colour, linestyle=style, label=name)
        axis.set(title=title, xlabel=r"time $t$", ylabel=label)
        axis.margins(x=0.02, y=0.12)
        if title in LOGARITHMIC:
            axis.set_yscale("log")
        if len(lines) > 1:
            legend_below(axis, len(lines))
        if release is not None and release > statistics["time"][0]:
            mark_time(axis, release, "tracers")
    for axis in axes.flat[len(shown):]:
        axis.remove()
    letter(axes.flat[: len(shown)])
    return figure


@styled
def spectra(
    wavenumber: np.ndarray, energy: np.ndarray, filtered: np.ndarray | None,
    scales: Mapping[str, float],
) -> Figure:
    """Energy spectrum at one time, the same compensated by eps^(-2/3) k^(5/3), and the transfer of the
    filter.

    Arrays (shells,); `filtered` None for a run without tracers. `scales`: dissipation_rate,
    kolmogorov_length, and filter_width where there is a filter. Without viscosity, or with three
    shells or fewer, nothing is compensated.
    """
    inside = (wavenumber >= 1) & (energy > 1e-12 * energy.max())
    k, spectrum = wavenumber[inside], energy[inside]
    compensated = scales["kolmogorov_length"] > 0 and k.size > 3
    figure, axes = panels(1, 1 + compensated + (filtered is not None), (3.7, 3.2))
    _energy_panel(axes[0, 0], k, spectrum, None if filtered is None else filtered[inside])
    if compensated:
        _compensated_panel(axes[0, 1], k, spectrum, scales)
    if filtered is not None:
        axes[0, 0].legend(loc="lower left")
        _transfer_panel(axes[0, -1], k, filtered[inside] / spectrum, scales["filter_width"])
    for axis in axes.flat:
        number_wavenumbers(axis)
    letter(axes.flat)
    return figure


@styled
def field_planes(velocity: np.ndarray, vorticity: np.ndarray) -> Figure:
    """u_x and the vorticity magnitude in a plane, both [y, x]."""
    figure, axes = panels(1, 2, (3.9, 3.1))
    limit = largest(velocity)
    image = show_plane(axes[0, 0], velocity, (-limit, limit), SIGNED)
    colour_bar(figure, image, axes[0, :1], "$u_x$")
    image = show_plane(axes[0, 1], vorticity, (0, largest(vorticity)), POSITIVE)
    colour_bar(figure, image, axes[0, 1:], r"$|\omega|$", extend="max")
    for axis in axes.flat:
        axis.set(xlabel="$x$", ylabel="$y$")
    letter(axes.flat)
    return figure


def _known(statistics: Mapping[str, np.ndarray], column: str) -> bool:
    return column in statistics and bool(np.isfinite(statistics[column]).any())


def _energy_panel(axis: Axes, k: np.ndarray, energy: np.ndarray, filtered: np.ndarray | None) -> None:
    axis.loglog(k, energy, color=DNS, label="DNS", marker="o" if k.size < 8 else None)
    if filtered is not None:
        axis.loglog(k, filtered, color=FILTERED, linestyle="--", label="filtered DNS")
    guide = k[(k >= 2) & (k <= max(6, k.max() / 4))]
    if guide.size > 2:
        guide_power_law(axis, guide, 1.6 * energy[k == guide[0]][0], -5 / 3, r"$k^{-5/3}$")
    axis.set(title="Energy spectrum", xlabel="wavenumber $k$", ylabel="$E(k)$",
             ylim=(max(energy.min() / 2, 1e-8 * energy.max()), 4 * energy.max()))


def _compensated_panel(axis: Axes, k: np.ndarray, energy: np.ndarray, scales: Mapping[str, float]) -> None:
    compensated = k ** (5 / 3) * energy / scales["dissipation_rate"] ** (2 / 3)
    axis.loglog(k * scales["kolmogorov_length"], compensated, color=DNS)
    axis.axhspan(1.5, 1.64, color=GUIDE, alpha=0.35, linewidth=0)
    axis.annotate("1.5–1.64, high Re", (0.97, 1.64), xycoords=("axes fraction", "data"), xytext=(0, 2),
                  textcoords="offset points", ha="right", fontsize=8.5, color="#5a5a5a")
    axis.set(title="Compensated", xlabel=r"$k\,\eta$", ylabel=r"$\varepsilon^{-2/3}k^{5/3}E(k)$",
             ylim=(max(compensated.min() / 1.5, 1e-3), 2.5 * max(compensated.max(), 1.64)))


def _transfer_panel(axis: Axes, k: np.ndarray, ratio: np.ndarray, width: float) -> None:
    axis.semilogx(k, gaussian_transfer(k**2, width) ** 2, color=FILTERED, label=r"$\exp(-k^2d^2/12)$")
    axis.semilogx(k, ratio, "o", color=TRUTH, markersize=4, markerfacecolor="none", label="measured")
    axis.axvline(np.pi / width, color=GUIDE, linestyle=":", linewidth=1)
    axis.annotate(r"$k=\pi/d$", (np.pi / width, 0.02), xycoords=("data", "axes fraction"), xytext=(3, 2),
                  textcoords="offset points", fontsize=8.5, color="#5a5a5a")
    axis.set(title="Filter", xlabel="wavenumber $k$", ylabel="filtered energy / DNS energy",
             ylim=(-0.03, 1.08))
    axis.legend(loc="upper right")


@dataclass(frozen=True)
class StoredFlow:
    """The flow of a ground truth as stored: tables `statistics` and `spectra` (None without tracers), group
    `reference`.

    `planes` holds "velocity" (u_x) and "vorticity" (magnitude) [y, x] at z = pi of the last stored field,
    whose name says which it is. Spectra count time from the release of the tracers, statistics from the
    start.
    """

    statistics: Mapping[str, np.ndarray]
    spectra: Mapping[str, np.ndarray]
    reference: Mapping[str, float]
    planes: Mapping[str, np.ndarray]
    field_name: str

    @property
    def released_at(self) -> float | None:
        """When the tracers start, None if there are none."""
        return self.reference.get("released_at")

    @property
    def row(self) -> int:
        """Row of the statistics that the numbers belong to: the release, or the end without tracers."""
        if self.released_at is None:
            return -1
        return int(np.argmin(np.abs(self.statistics["time"] - self.released_at)))


def section(flow: StoredFlow) -> Section:
    """The ground truth: figures, and the numbers when the tracers start, or at the end without tracers."""
    at = {name: float(values[flow.row]) for name, values in flow.statistics.items()} | dict(flow.reference)
    when = "at the end" if flow.released_at is None else "when the tracers start"
    metrics = [Metric(key, label, at.get(key), "an incompressible fluid has none")
               for key, label in METRICS.items() if key in at or key == "mach_turbulent"]
    text = f"Direct numerical simulation. Numbers {when}, t = {at['time']:.3g}."
    shown = Section("ground_truth", "Ground truth", text, metrics=metrics,
                    main=("reynolds_lambda", "kmax_eta", "mach_turbulent"))
    first, last = flow.statistics["time"][[0, -1]]
    shown.add_figure(
        "statistics", "History of the simulation", statistics_history(flow.statistics, flow.released_at),
        f"From t = {first:.3g} to {last:.3g}. {when.capitalize()} the energy is {at['energy']:.3g} and the "
        f"dissipation rate {at['dissipation_rate']:.3g}.")
    _add_spectra(shown, flow)
    shown.add_figure("fields", "Velocity and vorticity", field_planes(**flow.planes),
                     f"Plane z = π of the last stored {flow.field_name} field.")
    return shown


def _add_spectra(shown: Section, flow: StoredFlow) -> None:
    frame = -1 if flow.released_at is None else int(np.argmin(np.abs(flow.spectra["time"])))
    energy, filtered = flow.spectra["energy"][frame], flow.spectra.get("filtered")
    scales = {"dissipation_rate": float(flow.statistics["dissipation_rate"][flow.row]),
              "kolmogorov_length": flow.reference["kolmogorov_length"]}
    caption = f"At t = {flow.statistics['time'][flow.row]:.3g}; η = {scales['kolmogorov_length']:.3g}."
    if filtered is not None:
        scales["filter_width"], filtered = flow.reference["filter_width"], filtered[frame]
        kept = filtered.sum() / energy.sum()
        caption += f" The filter of width d = {scales['filter_width']:.3g} keeps {kept:.1%} of the energy."
    figure = spectra(flow.spectra["wavenumber"], energy, filtered, scales)
    shown.add_figure("spectra", "Energy spectrum of the ground truth", figure, caption)
