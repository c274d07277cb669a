"""Averages of stationary isotropic turbulence, and values from the literature at the same Reynolds number.

u' is the rms of a velocity component, L the integral scale, eps the dissipation rate, eta Kolmogorov's length.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from eddies.analysis.block_averages import Blocks, Estimate
from eddies.measures import finite

# Range of published values: Sreenivasan, Phys. Fluids 7, 2778 (1995); Yeung & Zhou, Phys. Rev. E 56, 1746 (1997).
KOLMOGOROV_CONSTANT = (1.5, 1.64)
INERTIAL = (0.03, 0.2)  # range of k eta in which spectra are compared with Kolmogorov's constant
BOTTLENECK = 0.5  # largest k eta at which the maximum of a compensated spectrum is searched
COMPONENTS = ("energy_x", "energy_y", "energy_z")


def gradient_skewness(reynolds_lambda: float) -> float:
    """Return the skewness of the longitudinal velocity gradient, -0.32 Re_lambda^0.11.

    This is a fit to simulations at Re_lambda > 200 (Ishihara et al., J. Fluid Mech. 592, 335, 2007). Simulations at
    Re_lambda = 30 to 100 find -0.45 to -0.55.
    """
    return -0.32 * reynolds_lambda**0.11


def gradient_flatness(reynolds_lambda: float) -> float:
    """Return the flatness of the longitudinal velocity gradient, 1.14 Re_lambda^0.34.

    This is a fit to simulations at Re_lambda > 200 (Ishihara et al. 2007).
    """
    return 1.14 * reynolds_lambda**0.34


def dissipation_constant(reynolds_lambda: float) -> float:
    """Return C_eps = eps L / u'^3 = 0.2 (1 + sqrt(1 + (92 / Re_lambda)^2)). It tends to 0.4 at high Re_lambda.

    This is a fit to forced turbulence (Donzis, Sreenivasan & Yeung, J. Fluid Mech. 532, 199, 2005).
    """
    return float(0.2 * (1 + np.sqrt(1 + (92 / reynolds_lambda) ** 2)))


def acceleration_constant(reynolds_lambda: float) -> float:
    """Return a_0 = <a^2> nu^(1/2) / eps^(3/2) = 5 / (1 + 110 / Re_lambda) for a flow that is not filtered.

    a is an acceleration component, and nu the kinematic viscosity (Sawford et al., Phys. Fluids 15, 3478, 2003).
    """
    return 5 / (1 + 110 / reynolds_lambda)


def modes_per_shell(largest: int) -> np.ndarray:
    """Return the number of integer wavevectors whose length rounds to 0, 1, ..., `largest`: (largest + 1,)."""
    k = np.arange(largest + 1)
    twins = np.where(k == 0, 1, 2)  # a component k > 0 also stands for -k
    squared, weights = np.add.outer(k**2, k**2), np.multiply.outer(twins, twins).ravel()
    modes = np.zeros(largest + 1)
    for kz, twin in zip(k, twins):
        shell = np.rint(np.sqrt(squared + kz**2)).astype(int).ravel()
        modes += twin * np.bincount(shell, weights)[:largest + 1]
    return modes


@dataclass(frozen=True)
class Row:
    """A quantity of this flow and its value in the literature.

    `deviation` is the standard deviation of the quantity in time. It is None if the value is not a time average.
    `error` is the standard error of the value. It is None if it is unknown, for example because the average is over
    fewer than two turnovers. `literature` is a number or a text, and `source` says where it comes from.
    """

    key: str
    label: str
    value: float
    deviation: float | None = None
    literature: float | str | None = None
    source: str = ""
    error: float | None = None


class StationarySpan:
    """The samples of a stationary flow between two times.

    Parameters
    ----------
    statistics : columns (samples,) of the table `statistics` of a ground truth.
    spectra : E(k) at every sample, (samples, shells), k = 0, 1, ...
    viscosity : kinematic viscosity.
    start, end : first and last time.
    forced_below : modes with 0 < |k| < forced_below are forced; 0 without forcing.

    Raises ValueError if the span holds fewer than three samples.
    """

    def __init__(self, statistics: Mapping[str, np.ndarray], spectra: np.ndarray, viscosity: float, start: float,
                 end: float, forced_below: float) -> None:
        inside = (statistics["time"] >= start) & (statistics["time"] <= end)
        if inside.sum() < 3:
            raise ValueError(f"only {inside.sum()} samples from t = {start:g} to {end:g}: at least 3 are needed")
        self.columns = {name: values[inside] for name, values in statistics.items()}
        self.viscosity, self.forced_below = viscosity, forced_below
        interval = np.diff(self.columns["time"])
        # Weights of the trapezoidal rule: time steps vary, and so do the intervals between samples.
        self._weights = (np.append(interval, 0) + np.append(0, interval)) / (2 * interval.sum())
        self.spectra = spectra[inside]
        self.spectrum = self._weights @ self.spectra

    @property
    def turnovers(self) -> float:
        return float(self.columns["turnovers"][-1] - self.columns["turnovers"][0])

    @property
    def steps_per_turnover(self) -> float:
        return float(np.sum(np.diff(self.columns["time"]) / self.columns["time_step"][1:]) / self.turnovers)

    def mean(self, name: str) -> float:
        return self.average(self.columns[name])[0]

    def average(self, values: np.ndarray) -> tuple[float, float]:
        """Return the time average of values (samples,), and their standard deviation in time."""
        mean = float(self._weights @ values)
        return mean, float(np.sqrt(self._weights @ (values - mean) ** 2))

    def block_mean(self, values: np.ndarray) -> Estimate:
        """Return the time average of values (samples,). Its standard error comes from blocks of at least a turnover."""
        return Estimate(self.average(values)[0], self._blocks.mean(values).error)

    @property
    def energy_trend(self) -> Estimate:
        """Relative change of the energy per turnover: the slope of the regression line of energy / mean energy."""
        return self._blocks.trend(self.columns["energy"] / self.mean("energy"))

    @cached_property
    def _blocks(self) -> Blocks:
        return Blocks.of(self.columns["turnovers"], 1.0)

    @property
    def energy_imbalance(self) -> float:
        """(mean injection - mean dissipation - growth of the energy per time) / mean dissipation."""
        energy, time, dissipation = self.columns["total_energy"], self.columns["time"], self.mean("dissipation_rate")
        growth = (energy[-1] - energy[0]) / (time[-1] - time[0])
        return float((self.mean("injection_rate") - dissipation - growth) / dissipation)

    @property
    def kolmogorov_length(self) -> float:
        """Kolmogorov's length eta from the mean dissipation rate."""
        return float((self.viscosity**3 / self.mean("dissipation_rate")) ** 0.25)

    def compensated_spectrum(self) -> tuple[np.ndarray, np.ndarray]:
        """Return k eta and eps^(-2/3) k^(5/3) E(k) of the mean spectrum, for k = 1 to the last complete shell.

        Here E(k) is 4 pi k^2 times the mean energy of a mode of the shell, because the number of modes in a shell
        differs from 4 pi k^2: at k = 1 it is 18 instead of 12.6.
        """
        cutoff = int(np.rint(self.columns["kmax_eta"][-1] / self.columns["kolmogorov_length"][-1]))
        k = np.arange(1, cutoff + 1)
        energy = self.spectrum[k] * 4 * np.pi * k**2 / modes_per_shell(cutoff)[k]
        return k * self.kolmogorov_length, self.mean("dissipation_rate") ** (-2 / 3) * k ** (5 / 3) * energy

    def unforced(self) -> tuple[np.ndarray, np.ndarray]:
        """Return `compensated_spectrum`, but only in the shells without a forced mode."""
        k_eta, compensated = self.compensated_spectrum()
        free = np.arange(1, len(k_eta) + 1) >= self.forced_below + 0.5
        return k_eta[free], compensated[free]

    def enstrophy_skewness(self) -> np.ndarray:
        """Return the skewness S of the longitudinal gradient, (samples,), from the enstrophy budget of isotropic flow.

        The budget is -S (35/2) (W/15)^(3/2) = nu <|grad w|^2> + 1/2 dW/dt. w is the vorticity, W = <w.w> = eps/nu the
        enstrophy, and <|grad w|^2> = 2 sum k^4 E(k) (Batchelor & Townsend, Proc. R. Soc. A 190, 534, 1947). The
        enstrophy that the forcing injects is neglected. It is 1 % of the budget at Re_lambda = 85, and 8 % at 25.
        """
        enstrophy = self.columns["dissipation_rate"] / self.viscosity
        destroyed = 2 * self.viscosity * self.spectra @ np.arange(self.spectra.shape[1]) ** 4.0
        growth = np.gradient(enstrophy, self.columns["time"]) / 2
        return -(destroyed + growth) / (17.5 * (enstrophy / 15) ** 1.5)

    def component_shares(self) -> np.ndarray:
        """Return the energy of each velocity component divided by the mean energy of the three, (3, samples)."""
        energies = np.array([self.columns[name] for name in COMPONENTS])
        return energies / energies.mean(axis=0)


def comparison(span: StationarySpan) -> list[Row]:
    """Return quantities of isotropic turbulence in this flow, with their values in the literature at its Re_lambda."""
    def averaged(key: str, label: str, values: np.ndarray, *literature) -> Row:
        error = finite(span.block_mean(values).error)
        return Row(key, label, *span.average(values), *literature, error=error)

    c = span.columns
    reynolds, trend = span.mean("reynolds_lambda"), span.energy_trend
    dissipation = c["dissipation_rate"] * c["integral_scale"] / c["velocity_rms"] ** 3
    gradients = "Ishihara et al. 2007, fit at Re_λ > 200"
    rows = [
        Row("turnovers", "large-eddy turnovers in the average", span.turnovers),
        averaged("reynolds_lambda", "Re_λ", c["reynolds_lambda"]),
        averaged("kmax_eta", "k_max η", c["kmax_eta"], "1 or more", "Eswaran & Pope 1988"),
        averaged("skewness", "skewness of the longitudinal gradient", c["skewness"],
                 gradient_skewness(reynolds), gradients),
        averaged("enstrophy_skewness", "the same from the enstrophy budget of an isotropic flow",
                 span.enstrophy_skewness(), gradient_skewness(reynolds), gradients),
        averaged("flatness", "flatness of the longitudinal gradient", c["flatness"],
                 gradient_flatness(reynolds), gradients),
        averaged("dissipation_constant", "C_ε = ε L / u′³", dissipation, dissipation_constant(reynolds),
                 "Donzis et al. 2005, fit to forced flows"),
        *_spectrum_rows(span),
        *(averaged(f"share_{name[-1]}", f"energy of u_{name[-1]} over the mean of the components", values, 1.0,
                   "isotropy") for name, values in zip(COMPONENTS, span.component_shares())),
        Row("energy_trend", "trend of the energy, per turnover", trend.value, None, 0.0, "stationarity",
            finite(trend.error)),
        Row("energy_imbalance", "(injection − dissipation − dE/dt) / dissipation", span.energy_imbalance, None, 0.0,
            "energy budget"),
        Row("time_step", "time step", span.mean("time_step")),
        Row("steps_per_turnover", "time steps per turnover", span.steps_per_turnover),
    ]
    return rows + (_compressibility_rows(span) if "mach_turbulent" in c else [])


def _spectrum_rows(span: StationarySpan) -> list[Row]:
    """Return rows for the mean and the maximum of the compensated spectrum in the shells without forcing.

    Each of them is measured in a range of k eta. It is left out if this range has no such shell.
    """
    k_eta, compensated = span.unforced()
    inertial = compensated[(k_eta >= INERTIAL[0]) & (k_eta <= INERTIAL[1])]
    constant = "{}–{}, more in a bottleneck".format(*KOLMOGOROV_CONSTANT)
    sources = "Sreenivasan 1995, Yeung & Zhou 1997"
    rows = []
    if inertial.size:
        label = "compensated spectrum, unforced shells: mean at {} ≤ kη ≤ {}".format(*INERTIAL)
        rows.append(Row("compensated_spectrum", label, float(inertial.mean()), None, constant, sources))
    searched = k_eta <= BOTTLENECK
    if searched.any():
        top = int(np.argmax(compensated[searched]))
        rows += [Row("bottleneck", "compensated spectrum, unforced shells: maximum", float(compensated[top]), None,
                     f"above {KOLMOGOROV_CONSTANT[1]}", sources),
                 Row("bottleneck_k_eta", "kη of the maximum", float(k_eta[top]), None, "0.1–0.2", "Yeung & Zhou 1997")]
    return rows


def _compressibility_rows(span: StationarySpan) -> list[Row]:
    """Return rows for the turbulent Mach number M_t, and for quantities that vary as a power of M_t if it is small.

    The density follows the pressure of the incompressible flow, rho' = p / c^2. Therefore rho_rms is proportional to
    M_t^2, and the compressible velocity to M_t^2 u' (pseudo-sound: Ristorcelli, J. Fluid Mech. 347, 37, 1997).
    """
    c, squared = span.columns, span.columns["mach_turbulent"] ** 2
    longitudinal = np.sqrt(c["compressible_fraction"])
    return [Row(key, label, *span.average(values)) for key, label, values in (
        ("mach_turbulent", "M_t = √⟨u·u⟩ / c", c["mach_turbulent"]),
        ("compressible_fraction", "compressible fraction χ of the kinetic energy", c["compressible_fraction"]),
        ("compressible_velocity_over_mach_squared", "√χ / M_t²", longitudinal / squared),
        ("density_rms_over_mach_squared", "ρ_rms / (ρ₀ M_t²)", c["density_rms"] / squared))]
