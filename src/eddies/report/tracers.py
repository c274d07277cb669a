"""The report section on the tracers of the ground truth."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eddies.analysis.isotropic_turbulence import acceleration_constant
from eddies.analysis.pdfs import bin_centres, gaussian
from eddies.analysis.tracer_statistics import EDGES, TracerStatistics
from eddies.report.figures import BLUE, DNS, FOURTH, GUIDE, MODEL, SECOND, letter, number_wavenumbers, panels, styled
from eddies.report.page import Section

COLOURS = (BLUE, MODEL, SECOND, FOURTH)
LABELS = {
    "tracer_energy_ratio_first": "⟨v·v⟩ of tracers / filtered field, at the release",
    "tracer_energy_ratio_last": "the same ratio at the last stored field",
    "tracer_energy_sampling_error": "sampling error of the ratio at the release (standard deviation)",
    "acceleration_kurtosis": "kurtosis of the acceleration (Gaussian: 3)",
    "structure_function_exponent": "exponent of the Lagrangian structure function at short lags (smooth: 2)",
    "ballistic_exponent": "exponent of the pair dispersion at short times (ballistic: 2)",
    "ballistic_prefactor": "⟨|r − r₀|²⟩ / (S₂(r₀) t²) at the first frame after the release (ballistic: 1)"}
TOO_FEW = "there are too few frames, or too few pairs of tracers"


def section(found: TracerStatistics, scales: Mapping[str, float], power: float | None,
            filtered: bool = True) -> Section:
    """Return the section on the tracers.

    scales: attributes of the group `reference` of ground_truth.h5, which hold at the release of the tracers. power:
    power of the forcing per mass; None if it is unknown. filtered: whether the tracers follow the filtered flow;
    otherwise they follow the whole flow.
    """
    kurtosis, (first, last) = found.kurtosis, found.energy_ratio[[0, -1]]
    numbers = {"tracer_energy_ratio_first": float(first), "tracer_energy_ratio_last": float(last),
               "tracer_energy_sampling_error": float(found.energy_error[0]), "acceleration_kurtosis": kurtosis}
    labels = LABELS
    if scales["viscosity"] > 0:
        numbers["acceleration_constant"] = float(
            found.acceleration_rms**2 * scales["viscosity"] ** 0.5 / scales["dissipation_rate"] ** 1.5)
        labels = {**LABELS, "acceleration_constant": "a_0 = a_rms² ν^½ ε^(−3/2) at the release (unfiltered flow: "
                  f"{acceleration_constant(scales['reynolds_lambda']):.3g}, Sawford et al. 2003)"}
    numbers |= {"structure_function_exponent": found.structure_exponent,
                "ballistic_exponent": found.ballistic_exponent, "ballistic_prefactor": found.ballistic_prefactor}
    text = f"Tracers follow the {'filtered' if filtered else 'whole'} flow."
    if power is not None:
        text += f" It stays forced with a power of {power:.3g} per mass." if power > 0 else " It is not forced."
    if filtered:
        text += (" Their accelerations are those of the eddies that pass the filter. They are smaller than the "
                 "literature's for the whole flow.")
    shown = Section("tracers", "Tracers", text, numbers, labels, dict.fromkeys(numbers, TOO_FEW))
    shown.add_figure(
        "tracers", "Statistics of the tracers", lambda: tracers(found, scales),
        "A: energy; grey: two standard deviations for the same number of random points. B: accelerations from "
        f"differences of frames, in units of their rms at the time; kurtosis {kurtosis:.3g}. C: structure function of "
        "a velocity component. D: pairs by their initial distance r₀; dashed: the ballistic law S₂(r₀) t² from their "
        "initial velocities.")
    return shown


@styled
def tracers(found: TracerStatistics, scales: Mapping[str, float]) -> Figure:
    """Draw the ratio of tracer to field energy, the acceleration PDF, the structure function and the pair dispersion.

    scales: see `section`. Lags and the times and lengths of pairs are in Kolmogorov units or, without viscosity, in
    units of the large eddies.
    """
    viscous = scales["viscosity"] > 0
    time_unit, time_name = (scales["kolmogorov_time"], r"t_\eta") if viscous else (scales["eddy_turnover_time"], "T")
    length, length_name = (scales["kolmogorov_length"], r"\eta") if viscous else (scales["integral_scale"], "L")
    figure, axes = panels(2, 2, (4.6, 2.9))
    energy, acceleration, memory, spreading = axes.flat
    _energy_panel(energy, found, scales["eddy_turnover_time"])
    centres = bin_centres(EDGES)
    seen = found.probability > 0
    acceleration.semilogy(centres[seen], found.probability[seen], color=BLUE, label="tracers")
    acceleration.semilogy(centres, gaussian(centres), color=GUIDE, linestyle="--", label="Gaussian")
    reach = np.abs(centres[seen]).max(initial=5.0) + 1
    acceleration.set(title="Acceleration", xlabel=r"$a_i\,/\,a_{rms}$", ylabel="PDF", xlim=(-reach, reach),
                     ylim=(found.probability[seen].min(initial=1e-3) / 2, 2))
    acceleration.legend()
    lags, squared = found.lags / time_unit, found.structure[0] * (found.lags / found.lags[0]) ** 2
    memory.loglog(lags, found.structure, "o-", color=BLUE, markersize=3.5)
    _guide(memory, lags, squared, found.structure.max(), r"$\tau^2$")
    memory.set(title="Structure function", xlabel=rf"lag $\tau/{time_name}$",
               ylabel=r"$\langle(\Delta_\tau v_i)^2\rangle$")
    memory.legend()
    time = found.times[1:]
    for pairs, colour in zip(found.dispersion, COLOURS):
        spreading.loglog(time / time_unit, pairs.spread[1:] / length**2, color=colour,
                         label=rf"$r_0={pairs.distance / length:.2g}\,{length_name}$")
        _guide(spreading, time / time_unit, pairs.structure * time**2 / length**2, pairs.spread.max() / length**2)
    spreading.set(title="Pair dispersion", xlabel=rf"time $t/{time_name}$",
                  ylabel=rf"$\langle|r-r_0|^2\rangle\,/\,{length_name}^2$")
    if found.dispersion:
        spreading.legend()
    for axis in (memory, spreading):
        number_wavenumbers(axis)
    letter(axes.flat)
    return figure


def _energy_panel(axis: Axes, found: TracerStatistics, turnover: float) -> None:
    time, error = found.field_times / turnover, 2 * found.energy_error
    axis.fill_between(time, 1 - error, 1 + error, color=GUIDE, alpha=0.3, linewidth=0)
    axis.axhline(1, color=GUIDE, linestyle="--", linewidth=1.1)
    axis.plot(time, found.energy_ratio, "o-", color=BLUE, markersize=3)
    reach = 1.3 * max(np.abs(found.energy_ratio - 1).max(), error.max())
    axis.set(title="Energy, tracers / field", xlabel="time $t/T$", ylabel=r"$\langle v\cdot v\rangle$ ratio",
             ylim=(1 - reach, 1 + reach))


def _guide(axis: Axes, x: np.ndarray, law: np.ndarray, highest: float, label: str | None = None) -> None:
    """Draw the values `law` over `x` as a dashed line, but only where they are at most `highest`."""
    below = law <= highest
    axis.loglog(x[below], law[below], color=DNS, linestyle="--", linewidth=1, label=label)
