"""The statistics of a flow over time, and its energy budget."""

from __future__ import annotations

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


EVERY = 4  # steps between two samples


class FlowHistory:
    """An observer that measures a flow every few steps: for each sample a row in `rows` and E(k) in `spectra`.

    Whoever needs the flow of a certain time, such as the last of a run, takes a `sample` then.
    Also integrates the energy budget: `budget_error` is |E(t) - E(0) - integral of (injection - dissipation)| over
    the dissipated energy (over E(0) where nothing is dissipated).
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
        """The row of now, measured and added unless the last one is of this very step.

        Raises FlowDiverged if the flow is not finite.
        """
        if self.rows and clock.steps == self._steps:
            return self.rows[-1]
        row, spectrum = self._measure(state)
        FlowDiverged.unless_finite(row["total_energy"], clock)
        if self.rows:
            last, elapsed = self.rows[-1], clock.time - self.rows[-1]["time"]
            self._injected += elapsed * row["injection_rate"]
            self._dissipated += elapsed / 2 * (last["dissipation_rate"] + row["dissipation_rate"])
            row["turnovers"] = last["turnovers"] + elapsed / row["eddy_turnover_time"]
        else:
            row["turnovers"] = 0.0
        now, steps = time.perf_counter(), max(clock.steps - self._steps, 1)
        row |= {"time": clock.time, "time_step": (clock.time - self.rows[-1]["time"]) / steps if self.rows else 0.0,
                "seconds_per_step": (now - self._wall) / steps}
        self._wall, self._steps = now, clock.steps
        self.rows.append(row)
        self.spectra.append(spectrum)
        return row

    def leave_out(self, seconds: float) -> None:
        """Count wall time since the last sample as no part of the steps."""
        self._wall += seconds

    @property
    def budget_error(self) -> float:
        """Normalised error of the energy budget from the first sample to the last."""
        first, last = self.rows[0]["total_energy"], self.rows[-1]["total_energy"]
        defect = abs(last - first - self._injected + self._dissipated)
        scale = self._dissipated if self._dissipated > 0 else first
        return defect / scale if scale > 0 else defect

    def columns(self) -> dict[str, np.ndarray]:
        """All rows as columns."""
        return {name: np.array([row[name] for row in self.rows]) for name in self.rows[0]}

    def state_dict(self) -> dict[str, Any]:
        """All that goes on, for a checkpoint: columns of `rows`, `spectra`, and the work done since the first."""
        columns = self.columns()
        return {"history": {"injected": self._injected, "dissipated": self._dissipated, "steps": self._steps,
                            "columns": list(columns)},
                "spectra_of_history": np.array(self.spectra),
                **{f"history_{name}": values for name, values in columns.items()}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Inverse of `state_dict`."""
        known = state["history"]
        columns = {name: state[f"history_{name}"] for name in known["columns"]}
        self.spectra = list(state["spectra_of_history"])
        self.rows = [dict(zip(columns, map(float, row))) for row in zip(*columns.values())]
        self._injected, self._dissipated, self._steps = known["injected"], known["dissipated"], int(known["steps"])
        self._wall = time.perf_counter()

    def describe(self) -> str:
        """The last sample in a few words."""
        row = self.rows[-1]
        return (f"t {row['time']:.3f} ({row['turnovers']:.2f} turnovers)  dt {row['time_step']:.4f}  "
                f"energy {row['energy']:.4f}  dissipation {row['dissipation_rate']:.4f}  "
                f"Re_lambda {row['reynolds_lambda']:.1f}")

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # what is not finite is told by who takes a sample
    def _measure(self, state: np.ndarray) -> tuple[dict[str, float], np.ndarray]:
        fluid, grid = self.fluid, self.fluid.grid
        velocity = state[:3]
        if fluid.compressible:
            row = compressible_budget(grid, state, fluid.viscosity, fluid.sound_speed)
        else:
            row = incompressible_budget(grid, velocity, fluid.viscosity)
            row["skewness"], row["flatness"] = gradient_moments(grid, velocity)
        _, spectrum = energy_spectrum(grid, velocity)
        row["energy"] = float(spectrum.sum())
        row |= component_energies(grid, velocity)
        row |= turbulence_scales(spectrum, row["dissipation_rate"], fluid.viscosity, grid.cutoff)
        row["injection_rate"] = fluid.forcing.injection_rate if fluid.forcing is not None else 0.0
        if fluid.compressible:
            row["mach_turbulent"] = float(np.sqrt(2 * row["energy"]) / fluid.sound_speed)
        return row, spectrum
