"""Eulerian large-eddy simulation on a coarse grid, with particles that follow its filtered velocity."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from eddies.clock import Clock
from eddies.flow.courant import CourantLimit
from eddies.flow.forcing import LinearForcing
from eddies.flow.initial_fields import balanced_density
from eddies.flow.navier_stokes import FLUIDS, Fluid
from eddies.flow.stability import quadratic_energy
from eddies.flow.subgrid import Closure, DynamicStress, EddyDamping, SpectralViscosity, StressModel
from eddies.flow.tracers import FilteredField, TracerParticles
from eddies.io.checkpoint import Block, Checkpoint
from eddies.io.weights import load_weights
from eddies.parallel.communicator import Comm
from eddies.parallel.migration import migrate
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.particle_set import ParticleSet
from eddies.scene.scene import Eulerian, Scene, SceneError
from eddies.spectral.mode_operators import gaussian_transfer
from eddies.spectral.spectral_grid import SpectralGrid, regrid
from eddies.time_stepping import ETDRK4
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.rollout.particle_run import injection
from eddies.workflows.rollout.saved_rows import restored_rows, saved_rows

# Runaway is a flow with this many times the energy of its start.
RUNAWAY_ENERGY = 100.0


class EulerianRun:
    """A fluid on a coarse grid, with a closure or without one, from a frame of the truth on.

    It starts from those modes of the unfiltered velocity that the grid keeps, or, where its equations are those of the
    filtered velocity, from the filter of them. The true particles follow the filtered velocity in either case.
    """

    def __init__(self, scene: Scene, truth: GroundTruth, start: int, directory: Path, device: torch.device) -> None:
        self.settings, self.longest_step = scene.eulerian or Eulerian(), scene.simulation.longest_step
        comm, length, width = truth.decomposition.comm, truth.decomposition.length, truth.scales.filter_width
        cells = self.settings.cells_for(width)
        grid = SpectralGrid(SlabDecomposition(comm, length, cells), scene.simulation.precision)
        # What is left for the filter to do to the fluid's velocity, and what it has done to it.
        filter_passed = self.settings.filter_passed(width)
        filter_left = 0.0 if filter_passed else width
        self.fluid = coarse_fluid(scene, truth, grid, filter_passed, directory)
        self.stepper, self.clock = ETDRK4(self.fluid), Clock()
        self.step_limit = CourantLimit(grid, scene.time.courant, math.inf)
        self.state = initial_state(truth, self.fluid, filter_passed, start)
        self.largest_energy = RUNAWAY_ENERGY * quadratic_energy(self.fluid, self.state)
        columns = truth.particles(start)
        columns = migrate(grid.decomposition, {name: columns[name] for name in ("id", "position")})
        field = FilteredField(grid, filter_left, scene.tracers.interpolation, margin=math.ceil(scene.time.courant))
        self.tracers = TracerParticles(field, columns, self.state)
        self.flow_seconds: list[float] = []

    @property
    def has_density(self) -> bool:
        """Whether the particles of its frames have a density."""
        return self.fluid.compressible

    @property
    def time(self) -> float:
        """Time of the flow since the start."""
        return self.clock.time

    def advance(self, until: float, number: int) -> str | None:
        """Take one of the equal steps to a time, as many as the Courant number of the flow now asks for, and none
        longer than that of the scene; what is wrong with the state after it, on all ranks, or None."""
        left = until - self.time
        longest = min(self.step_limit.bound(self.state, self.clock), self.longest_step)
        step = left / math.ceil(left / longest - 1e-9)
        began = time.perf_counter()
        with np.errstate(over="ignore", invalid="ignore"):  # said in words below
            if self.fluid.closure is not None:
                self.fluid.closure.begin_step(self.state[:3])
            self.state = self.stepper(self.state, step)
            energy = quadratic_energy(self.fluid, self.state)
        self.flow_seconds.append(time.perf_counter() - began)
        # Written so that what is not finite fails.
        if not energy <= self.largest_energy:
            return (f"step {number}: the coarse flow is unstable, its energy is {energy:.3g} and more than "
                    f"{RUNAWAY_ENERGY:g} times that of the start; lower [time] courant or [simulation] step")
        self.clock.tick(step)
        self.tracers.advance(self.state, step)
        return None

    def frame(self, time: float) -> tuple[ParticleSet, torch.Tensor]:
        """The particles, with the density of a compressible fluid, and their acceleration."""
        density = {"density": self.tracers.density(self.state)} if self.has_density else {}
        return ParticleSet.from_numpy(self.tracers.columns | density), torch.from_numpy(self._acceleration())

    def _acceleration(self) -> np.ndarray:
        """du/dt + v.grad u (n, 3) of the filtered velocity u at the particles: the rate of change of their velocity,
        exact but for the splines."""
        fluid, transfer = self.fluid, self.tracers.field.transfer
        velocity = transfer * self.state[:3]
        if fluid.closure is not None:
            fluid.closure.begin_step(self.state[:3])
        change = transfer * (fluid.linear(self.state) + fluid.nonlinear(self.state))[:3]
        gradients = [fluid.grid.gradient(component) for component in velocity]
        spline = self.tracers.field.spline
        values = spline.at(spline.coefficients(np.concatenate([change, *gradients])), self.tracers.columns["position"])
        along = np.einsum("nij,nj->ni", values[:, 3:].reshape(-1, 3, 3), self.tracers.columns["velocity"])
        return values[:, :3] + along

    def status(self) -> str:
        """Nothing."""
        return ""

    def series(self) -> dict[str, dict[str, list[float]]]:
        """None."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """All that goes on, for a checkpoint; collective."""
        grid = self.fluid.grid
        modes = Block(self.state, int(grid.column_starts[grid.decomposition.rank]), grid.modes, axis=2)
        return {"modes": modes, "clock": self.clock.state_dict(), "flow_seconds": self.flow_seconds,
                **saved_rows(grid.decomposition.comm, self.tracers.columns)}

    def load_state_dict(self, saved: Checkpoint) -> None:
        """Inverse of `state_dict`, bit for bit on the same number of ranks; collective."""
        grid = self.fluid.grid
        starts, rank = grid.column_starts, grid.decomposition.rank
        self.state = saved.read("modes", int(starts[rank]), int(starts[rank + 1]), axis=2)
        self.clock.load_state_dict(saved["clock"])
        self.flow_seconds = saved["flow_seconds"]
        columns, _ = restored_rows(grid.decomposition, saved)
        self.tracers = TracerParticles(self.tracers.field, columns, self.state)

    def description(self) -> dict[str, float | str]:
        """Grid and model; where there were steps, `flow_seconds_per_step` (median) is the flow's share of one, without
        the particles."""
        grid = self.fluid.grid
        seconds = {"flow_seconds_per_step": float(np.median(self.flow_seconds))} if self.flow_seconds else {}
        key = self.settings.form.constant
        constant = f", C_s = {getattr(self.settings, key):g}" if key else ""
        return {"integrator": "etdrk4", "cells": grid.cells, "largest_wavenumber": grid.cutoff,
                "fluid": self.settings.fluid, "equations": self.settings.equations,
                "closure": self.settings.closure + constant, **seconds}


def coarse_fluid(scene: Scene, truth: GroundTruth, grid: SpectralGrid, filter_passed: float,
                 directory: Path) -> Fluid:
    """The fluid of a coarse grid, whose velocity has passed a filter of some width or 0, with the forcing of the
    scene's particles and the closure of the scales that the grid or the filter leaves out."""
    settings, forcing = scene.eulerian or Eulerian(), None
    if (forced := injection(scene, truth)) is not None:
        forcing = LinearForcing(grid, forced.injection_rate, forced.wavenumber, filter_passed)
    sound_speed = scene.flow.sound_speed if settings.compressible else math.inf
    closure = closure_of(settings, grid, filter_passed, directory, scene.model and scene.model.damping)
    return FLUIDS[settings.fluid](grid, scene.flow.viscosity, sound_speed, forcing, closure=closure)


def closure_of(settings: Eulerian, grid: SpectralGrid, filter_width: float, directory: Path,
               damping: str | None) -> Closure | None:
    """The closure of the filtered equations, or, without a filter width, of the velocity that the grid cuts off at its
    highest wavenumber k_c; Delta is d, or pi/k_c. What is learned is read from model.h5 in the directory, where it is
    the parameter `damping` of a term."""
    width = filter_width or math.pi / grid.cutoff
    made = {
        "none": lambda: None,
        "smagorinsky": lambda: StressModel(grid, mixing_length=settings.smagorinsky * width),
        "dynamic-smagorinsky": lambda: DynamicStress(grid, filter_width),
        "spectral": lambda: SpectralViscosity(grid),
        "learned": lambda: EddyDamping(grid, learned_rates(grid.decomposition.comm, directory, damping)),
        "gradient": lambda: StressModel(grid, filter_width=filter_width),
        "dynamic-mixed": lambda: DynamicStress(grid, filter_width, with_gradient=True),
    }
    return made[settings.closure]()


def learned_rates(comm: Comm, directory: Path, damping: str | None) -> np.ndarray:
    """The rates of eddy damping that a model has learned."""
    _, weights = load_weights(comm, directory / "model.h5", "model")
    return weights[f"terms.{damping}"]


def initial_state(truth: GroundTruth, fluid: Fluid, filter_passed: float, frame: int) -> np.ndarray:
    """The modes that a fluid's grid keeps of the flow at a frame, its velocity passed through a filter; the density
    as it was, or in balance with a filtered velocity.

    Raises SceneError where the ground truth does not have the whole flow at that frame.
    """
    grid, series = fluid.grid, truth.states
    at = [index for index, time in enumerate(series.times) if abs(time - truth.times[frame]) < 1e-9]
    if not at:
        known = ", ".join(f"{time / truth.times[-1]:.3g}" for time in series.times) or "nowhere"
        raise SceneError(
            f'[simulation] method = "eulerian": the rollout starts at {truth.times[frame] / truth.times[-1]:.3g} of the'
            f" ground truth, which holds the unfiltered flow at {known}; start there ([simulation] start), or make the "
            "ground truth again for this start")
    slab = SlabDecomposition(grid.decomposition.comm, grid.decomposition.length, series.cells)
    whole = SpectralGrid(slab, grid.precision, (series.cells - 1) // 2)

    def kept(values: np.ndarray) -> np.ndarray:
        return regrid(whole, grid, whole.forward(values.astype(whole.real)))

    velocity = kept(truth.state(at[0], "velocity", slab))
    velocity *= gaussian_transfer(grid.wavenumber_squared, filter_passed).astype(grid.real)
    if not fluid.compressible:
        return grid.solenoidal(velocity)
    if filter_passed:
        return np.concatenate([velocity, balanced_density(grid, velocity, fluid.sound_speed)[None]])
    return np.concatenate([velocity, kept(np.log(truth.state(at[0], "density", slab)))])
