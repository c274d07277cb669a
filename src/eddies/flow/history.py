"""Time series of the statistics of a flow, and the flow's energy budget."""

import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from eddies.clock import Clock
from eddies.flow.navier_stokes import Fluid
from eddies.flow.stability import FlowDiverged
from eddies.flow.statistics import (
    component_energies, compressible_budget, energy_spectrum, gradient_moments, incompressible_budget,
    turbulence_scales,
)
from eddies.parallel.step_times import surplus_load

EVERY = 4  # steps between two samples
#: Columns of the run; the others describe the flow.
OF_THE_RUN = ("turnovers", "time", "time_step", "seconds_per_step", "surplus_load")
#: Units of the columns of a history; the others are pure numbers.
UNITS = {"time": "T", "time_step": "T", "seconds_per_step": "s", "eddy_turnover_time": "T", "kolmogorov_time": "T",
         **dict.fromkeys(("energy", "energy_x", "energy_y", "energy_z", "total_energy"), "L^2/T^2"),
         **dict.fromkeys(("dissipation_rate", "injection_rate"), "L^2/T^3"),
         **dict.fromkeys(("integral_scale", "taylor_scale", "kolmogorov_length"), "L"),
         "velocity_rms": "L/T", "density_rms": "M/L^3"}


class FlowHistory:
    """Observer that measures a flow every few steps: for each sample `rows` has a dict and `spectra` a spectrum E(k).

    It also integrates the energy budget of the total energy e(t). `budget_error` is
    |e(t) - e(0) - integral of (injection - dissipation)| divided by the dissipated energy, or by e(0) if no energy is
    dissipated.
    """

    def __init__(self, fluid: Fluid, every: int = EVERY) -> None:
        self.fluid, self.every = fluid, every
        self.rows: list[dict[str, float]] = []
        self.spectra: list[np.ndarray] = []
        self._injected = self._dissipated = 0.0
        self._wall, self._steps = time.perf_counter(), 0

    def __call__(self, state: np.ndarray, clock: Clock) -> None:
        """Take a sample if one is due."""
        if clock.steps % self.every == 0:
            self.sample(state, clock)

    def sample(self, state: np.ndarray, clock: Clock) -> dict[str, float]:
        """Measure the flow, store the sample and return its row; collective.

        If the last row already belongs to this step, only return that row. Raises FlowDiverged if the flow is not
        finite.
        """
        if self.rows and clock.steps == self._steps:
            return self.rows[-1]
        row, spectrum = self._measure(state)
        FlowDiverged.unless_finite(row["total_energy"], clock)
        now, steps = time.perf_counter(), max(clock.steps - self._steps, 1)
        row |= {"turnovers": 0.0, "time": clock.time, "time_step": 0.0, "seconds_per_step": (now - self._wall) / steps,
                "surplus_load": surplus_load()}
        if self.rows:
            last, elapsed = self.rows[-1], clock.time - self.rows[-1]["time"]
            self._injected += elapsed * row["injection_rate"]
            self._dissipated += elapsed / 2 * (last["dissipation_rate"] + row["dissipation_rate"])
            row["turnovers"] = last["turnovers"] + elapsed / row["eddy_turnover_time"]
            row["time_step"] = elapsed / steps
        self._wall, self._steps = now, clock.steps
        self.rows.append(row)
        self.spectra.append(spectrum)
        return row

    def leave_out(self, seconds: float) -> None:
        """Exclude `seconds` of wall time from the `seconds_per_step` of the next sample."""
        self._wall += seconds

    @property
    def budget_error(self) -> float:
        """Normalised error of the energy budget between the first and the last sample."""
        first, last = self.rows[0]["total_energy"], self.rows[-1]["total_energy"]
        defect = abs(last - first - self._injected + self._dissipated)
        scale = self._dissipated if self._dissipated > 0 else first
        return defect / scale if scale > 0 else defect

    def columns(self) -> dict[str, np.ndarray]:
        return {name: np.array([row[name] for row in self.rows]) for name in self.rows[0]}

    def state_dict(self) -> dict[str, Any]:
        """Return the rows, the spectra and the integrals of the energy budget, for a checkpoint."""
        columns = self.columns()
        return {"history": {"injected": self._injected, "dissipated": self._dissipated, "steps": self._steps,
                            "columns": list(columns)},
                "spectra_of_history": np.array(self.spectra),
                **{f"history_{name}": values for name, values in columns.items()}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        saved = state["history"]
        columns = {name: state[f"history_{name}"] for name in saved["columns"]}
        self.spectra = list(state["spectra_of_history"])
        self.rows = [dict(zip(columns, map(float, row))) for row in zip(*columns.values())]
        self._injected, self._dissipated, self._steps = saved["injected"], saved["dissipated"], int(saved["steps"])
        self._wall = time.perf_counter()

    def describe(self) -> str:
        """Return the last sample as text for the progress line."""
        row = self.rows[-1]
        return (f"t {row['time']:.4g} ({row['turnovers']:.2f} turnovers)  dt {row['time_step']:.4g}  "
                f"energy {row['energy']:.4g}  dissipation {row['dissipation_rate']:.4g}  "
                f"Re_lambda {row['reynolds_lambda']:.1f}")

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # `sample` reports what is not finite
    def _measure(self, state: np.ndarray) -> tuple[dict[str, float], np.ndarray]:
        fluid, grid = self.fluid, self.fluid.grid
        velocity = state[:3]
        if fluid.compressible:
            row = compressible_budget(grid, state, fluid.viscosity, fluid.sound_speed)
        else:
            row = incompressible_budget(grid, velocity, fluid.viscosity)
            row["skewness"], row["flatness"] = gradient_moments(grid, velocity)
        spectrum = energy_spectrum(grid, velocity)
        row["energy"] = float(spectrum.sum())
        row |= component_energies(grid, velocity)
        row |= turbulence_scales(spectrum, row["dissipation_rate"], fluid.viscosity, grid.cutoff)
        row["injection_rate"] = fluid.forcing.injection_rate if fluid.forcing is not None else 0.0
        if fluid.compressible:
            row["mach_turbulent"] = float(np.sqrt(2 * row["energy"]) / fluid.sound_speed)
        return row, spectrum
