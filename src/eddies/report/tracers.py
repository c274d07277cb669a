"""The report's part on the tracers of the ground truth: four statistics of theirs, and the numbers."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eddies.analysis.isotropic_turbulence import acceleration_constant
from eddies.analysis.pdfs import gaussian
from eddies.analysis.tracer_statistics import EDGES, TracerStatistics
from eddies.report.figures import DNS, FOURTH, GUIDE, MODEL, SECOND, TRUTH, letter, number_wavenumbers, panels, styled
from eddies.report.page import Metric, Section

COLOURS = (TRUTH, MODEL, SECOND, FOURTH)
TOO_FEW = "too few frames, or too few pairs of tracers"


@dataclass(frozen=True)
class Units:
    """Units of time and length, with their names: Kolmogorov's, or those of the large eddies without viscosity."""

    time: float
    time_name: str
    length: float
    length_name: str

    @classmethod
    def of(cls, scales: Mapping[str, float]) -> "Units":
        """The units by the scales of the flow when the tracers start."""
        if scales["viscosity"] > 0:
            return cls(scales["kolmogorov_time"], r"t_\eta", scales["kolmogorov_length"], r"\eta")
        return cls(scales["eddy_turnover_time"], "T", scales["integral_scale"], "L")


@styled
def tracers(found: TracerStatistics, scales: Mapping[str, float]) -> Figure:
    """Energy of the tracers over the field's, PDF of acceleration, structure function, pair dispersion.

    scales: of the flow when the tracers start, as a ground truth's `reference`.
    """
    units = Units.of(scales)
    figure, axes = panels(2, 2, (4.6, 3.1))
    energy, acceleration, memory, spreading = axes.flat
    _energy_panel(energy, found, scales["eddy_turnover_time"])
    centres = (EDGES[1:] + EDGES[:-1]) / 2
    seen = found.probability > 0
    acceleration.semilogy(centres[seen], found.probability[seen], color=TRUTH, label="tracers")
    acceleration.semilogy(centres, gaussian(centres), color=GUIDE, linestyle="--", label="Gaussian")
    reach = np.abs(centres[seen]).max(initial=5.0) + 1
    acceleration.set(title="Acceleration", xlabel=r"$a_i\,/\,a_{rms}$", ylabel="PDF", xlim=(-reach, reach),
                     ylim=(found.probability[seen].min(initial=1e-3) / 2, 2))
    acceleration.legend()
    lags, squared = found.lags / units.time, found.structure[0] * (found.lags / found.lags[0]) ** 2
    memory.loglog(lags, found.structure, "o-", color=TRUTH, markersize=3.5)
    _guide(memory, lags, squared, found.structure.max(), r"$\tau^2$")
    memory.set(title="Structure function", xlabel=rf"lag $\tau/{units.time_name}$",
               ylabel=r"$\langle(\Delta_\tau v_i)^2\rangle$")
    _dispersion_panel(spreading, found, units)
    for axis in (memory, spreading):
        number_wavenumbers(axis)
    letter(axes.flat)
    return figure


def section(found: TracerStatistics, scales: Mapping[str, float], power: float) -> Section:
    """Statistics of the tracers; scales: of the flow when they start, as a ground truth's `reference`; power: a mass,
    with which it is forced meanwhile."""
    kurtosis, (first, last) = found.kurtosis, found.energy_ratio[[0, -1]]
    metrics = [
        Metric("tracer_energy_ratio_first", "⟨v·v⟩ of tracers / filtered field, when the tracers start", float(first)),
        Metric("tracer_energy_ratio_last", "the same at the last stored field", float(last)),
        Metric("tracer_energy_sampling_error", "standard deviation of this ratio by random sampling",
               float(found.energy_error[0])),
        Metric("acceleration_kurtosis", "kurtosis of the acceleration (Gaussian: 3)", kurtosis),
        *_acceleration_constant(found, scales),
        Metric("structure_function_exponent", "first exponent of the Lagrangian structure function (τ²)",
               found.structure_exponent, TOO_FEW),
        Metric("ballistic_exponent", "first exponent of the pair dispersion (ballistic: t²)",
               found.ballistic_exponent, TOO_FEW),
        Metric("ballistic_prefactor", "⟨|r − r₀|²⟩ / S₂(r₀) t² at the first frame", found.ballistic_prefactor, TOO_FEW),
    ]
    forcing = f"which stays forced with a power of {power:.3g} a mass" if power > 0 else "without forcing"
    text = (f"Tracers follow the filtered flow, {forcing}: their accelerations are those of the eddies that the "
            "filter leaves, and fall below the literature's of the whole flow.")
    shown = Section("tracers", "Tracers", text, metrics=metrics)
    shown.add_figure(
        "tracers", "Statistics of the tracers", tracers(found, scales),
        f"A: grey, two standard deviations of as many points put at random. B: differences of frames, in units of "
        f"their rms at the time; kurtosis {kurtosis:.3g}. C: of a velocity component. D: pairs by their first distance "
        f"r₀; dashed, the ballistic law S₂(r₀) t² from their first velocities.")
    return shown


def _acceleration_constant(found: TracerStatistics, scales: Mapping[str, float]) -> list[Metric]:
    if scales["viscosity"] == 0:
        return []
    constant = found.acceleration_rms**2 * scales["viscosity"] ** 0.5 / scales["dissipation_rate"] ** 1.5
    whole = acceleration_constant(scales["reynolds_lambda"])
    return [Metric("acceleration_constant", "a_0 = a_rms² ν^½ ε^(−3/2) when the tracers start "
                   f"(whole flow: {whole:.3g}, Sawford et al. 2003)", float(constant))]


def _energy_panel(axis: Axes, found: TracerStatistics, turnover: float) -> None:
    time, error = found.field_times / turnover, 2 * found.energy_error
    axis.fill_between(time, 1 - error, 1 + error, color=GUIDE, alpha=0.3, linewidth=0)
    axis.axhline(1, color=GUIDE, linestyle="--", linewidth=1.1)
    axis.plot(time, found.energy_ratio, "o-", color=TRUTH, markersize=3)
    reach = 1.3 * max(np.abs(found.energy_ratio - 1).max(), error.max())
    axis.set(title="Energy, tracers / field", xlabel="time $t/T$", ylabel=r"$\langle v\cdot v\rangle$ ratio",
             ylim=(1 - reach, 1 + reach))


def _dispersion_panel(axis: Axes, found: TracerStatistics, units: Units) -> None:
    time, square = found.times[1:], units.length**2
    for pairs, colour in zip(found.dispersion, COLOURS):
        axis.loglog(time / units.time, pairs.spread[1:] / square, color=colour,
                    label=rf"$r_0={pairs.distance / units.length:.2g}\,{units.length_name}$")
        _guide(axis, time / units.time, pairs.structure * time**2 / square, pairs.spread.max() / square, None)
    axis.set(title="Pair dispersion", xlabel=rf"time $t/{units.time_name}$",
             ylabel=rf"$\langle|r-r_0|^2\rangle\,/\,{units.length_name}^2$")
    if found.dispersion:
        axis.legend()


def _guide(axis: Axes, x: np.ndarray, law: np.ndarray, highest: float, label: str | None) -> None:
    """A dashed law as far as it stays below what is measured at most."""
    below = law <= highest
    axis.loglog(x[below], law[below], color=DNS, linestyle="--", linewidth=1, label=label)
    if label:
        axis.legend()
