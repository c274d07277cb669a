"""The report section on the ground truth: history of its statistics, energy spectra, fields."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from eddies.report.figures import (BAR, BLUE, DNS, FILTERED, FOURTH, MODEL, POSITIVE, SECOND, SIGNED,
                                   Table, colour_bar, guide_power_law, largest, legend_below, letter, mark_cutoff,
                                   mark_time, number_wavenumbers, panels, show_plane, styled)
from eddies.report.page import Section

# Panels of the history: title, axis label, and the columns with their labels, colours and line styles.
HISTORY = (
    ("Kinetic energy", r"$\frac{1}{2}\langle u\cdot u\rangle$", (("energy", None, DNS, "-"),)),
    ("Dissipation", "energy rate", (
        ("dissipation_rate", "dissipation", BLUE, "-"),
        ("injection_rate", "injection", FOURTH, "--"))),
    ("Taylor Reynolds number", r"$Re_\lambda$", (("reynolds_lambda", None, DNS, "-"),)),
    ("Resolution", r"$k_{\max}\,\eta$", (("kmax_eta", None, DNS, "-"),)),
    ("Compressibility", "fraction", (
        ("mach_turbulent", r"$M_t$", BLUE, "-"),
        ("density_rms", r"$\rho_{rms}/\rho_0$", MODEL, "--"),
        ("compressible_fraction", "energy", SECOND, "-."))),
    ("Longitudinal gradient", "moment", (
        ("skewness", "skewness", BLUE, "-"),
        ("flatness", "flatness", MODEL, "--"))),
)
# The panel with a logarithmic axis, and the smallest value in it: smaller ones are only rounding errors.
LOGARITHMIC, SMALLEST = "Compressibility", 1e-8
LABELS = {
    "reynolds_lambda": "Taylor Reynolds number Re_λ", "kmax_eta": "resolution k_max η",
    "mach_turbulent": "turbulent Mach number M_t",
    "energy_budget_error": "relative error of the energy budget",
    "skewness": "skewness of the longitudinal gradient", "flatness": "flatness of the longitudinal gradient",
    "energy": "kinetic energy", "dissipation_rate": "dissipation rate ε", "integral_scale": "integral scale",
    "eddy_turnover_time": "eddy turnover time T", "kolmogorov_time": "Kolmogorov time",
    "density_rms": "density rms", "filter_width": "filter width d", "spacing": "mean particle spacing",
    "velocity_rms": "velocity rms of the tracers", "acceleration_rms": "acceleration rms of the tracers",
}
REASONS = {"mach_turbulent": "an incompressible fluid has none",
           "kmax_eta": "nothing is dissipated, so there is no smallest scale to resolve"}


def section(statistics: Table, spectra: Table, reference: Mapping[str, float], planes: Table,
            field_name: str, source: str) -> Section:
    """Return the section, with numbers at the release of the tracers, or at the end if there are no tracers.

    statistics, spectra, reference: the tables and the attributes with these names in ground_truth.h5. Times in
    `spectra` count from the release of the tracers, and times in `statistics` from the start of the simulation.
    planes: arrays [y, x] of the last stored field at z = pi; "velocity" is u_x, and "vorticity" the magnitude of the
    vorticity. field_name: the kind of this field, "filtered" or "final". source: a sentence on where the flow comes
    from.
    """
    released, times = reference.get("released_at"), statistics["time"]
    row = -1 if released is None else int(np.argmin(np.abs(times - released)))
    # Without dissipation there is no Kolmogorov length, which is stored as 0.
    statistics = {name: np.where(values > 0, values, np.nan) if name == "kmax_eta" else values
                  for name, values in statistics.items()}
    eta = reference["kolmogorov_length"]
    at = {name: float(values[row]) for name, values in statistics.items()} | dict(reference)
    if eta == 0:
        at["kmax_eta"] = None
    when = "at the end" if released is None else "at the release of the tracers"
    shown = Section(
        "ground_truth", "Ground truth", f"{source} Numbers {when}, t = {at['time']:.3g}.",
        {key: at.get(key) for key in LABELS if key in at or key == "mach_turbulent"}, LABELS, REASONS)
    shown.add_figure(
        "statistics", "History of the simulation", lambda: statistics_history(statistics, released),
        f"From t = {times[0]:.3g} to {times[-1]:.3g}. Energy {when}: {at['energy']:.3g}; dissipation rate: "
        f"{at['dissipation_rate']:.3g}.")
    frame = -1 if released is None else int(np.argmin(np.abs(spectra["time"])))
    energy, filtered, width = spectra["energy"][frame], None, reference.get("filter_width")
    caption = f"At t = {times[row]:.3g}" + (f"; η = {eta:.3g}." if eta > 0 else ".")
    if "filtered" in spectra:
        filtered = spectra["filtered"][frame]
        caption += (f" The filter of width d = {width:.3g} keeps {filtered.sum() / energy.sum():.1%} of the energy. "
                    "Dotted: its wavenumber k_d = π/d.")
    shown.add_figure("spectra", "Energy spectrum of the ground truth",
                     lambda: energy_spectra(spectra["wavenumber"], energy, filtered, width), caption)
    shown.add_figure("fields", "Velocity and vorticity", lambda: field_planes(**planes),
                     f"Plane z = π of the last stored {field_name} field.")
    return shown


@styled
def statistics_history(statistics: Table, release: float | None) -> Figure:
    """Draw the columns (samples,) of `statistics` over time, and mark the time `release` of the tracers.

    Panels without finite values are left out. Without tracers, `release` is None.
    """
    known = {name for name, values in statistics.items() if np.isfinite(values).any()}
    shown = [(title, label, [line for line in lines if line[0] in known]) for title, label, lines in HISTORY]
    shown = [panel for panel in shown if panel[2]]
    figure, axes = panels(-(-len(shown) // 3), 3, (3.6, 2.7), below=0.2)
    for axis, (title, label, lines) in zip(axes.flat, shown):
        for column, name, colour, style in lines:
            values = statistics[column]
            if title == LOGARITHMIC:
                values = np.where(values > SMALLEST, values, np.nan)
            axis.plot(statistics["time"], values, color=colour, linestyle=style, label=name)
        axis.set(title=title, xlabel=r"time $t$", ylabel=label)
        axis.margins(x=0.02, y=0.12)
        if title == LOGARITHMIC:
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
def energy_spectra(wavenumber: np.ndarray, energy: np.ndarray, filtered: np.ndarray | None,
                   filter_width: float | None) -> Figure:
    """Draw the energy spectra (shells,) of the flow and of the filtered flow at one time.

    Without tracers, `filtered` and `filter_width` are None.
    """
    inside = (wavenumber >= 1) & (energy > 1e-12 * energy.max())
    k, spectrum = wavenumber[inside], energy[inside]
    figure, ((axis,),) = panels(1, 1, (5.0, 3.6))
    axis.loglog(k, spectrum, color=DNS, label="DNS", marker="o" if k.size < 8 else None)
    if filtered is not None:
        axis.loglog(k, filtered[inside], color=FILTERED, linestyle="--", label="filtered DNS")
        mark_cutoff(axis, np.pi / filter_width)
    guide = k[(k >= 2) & (k <= max(6, k.max() / 4))]
    if guide.size > 2:
        guide_power_law(axis, guide, 1.6 * spectrum[k == guide[0]][0], -5 / 3, r"$k^{-5/3}$")
    axis.set(xlabel="wavenumber $k$", ylabel="$E(k)$",
             ylim=(max(spectrum.min() / 2, 1e-8 * spectrum.max()), 4 * spectrum.max()))
    axis.legend(loc="lower left")
    number_wavenumbers(axis)
    return figure


@styled
def field_planes(velocity: np.ndarray, vorticity: np.ndarray) -> Figure:
    """Draw planes [y, x] of u_x and the vorticity magnitude."""
    figure, axes = panels(1, 2, (4.4, 3.54), right=BAR)
    limit = largest(velocity)
    image = show_plane(axes[0, 0], velocity, (-limit, limit), SIGNED)
    colour_bar(figure, image, axes[0, :1], "$u_x$")
    image = show_plane(axes[0, 1], vorticity, (0, largest(vorticity)), POSITIVE)
    colour_bar(figure, image, axes[0, 1:], r"$|\omega|$", extend="max")
    for axis in axes.flat:
        axis.set(xlabel="$x$", ylabel="$y$")
    letter(axes.flat)
    return figure
