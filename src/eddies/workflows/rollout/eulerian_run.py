"""Eulerian large-eddy simulation on a coarse grid, with particles that follow its velocity."""

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
from eddies.flow.navier_stokes import CompressibleFluid
from eddies.flow.operators import gradient
from eddies.flow.stability import quadratic_energy
from eddies.flow.subgrid import Smagorinsky
from eddies.flow.tracers import FilteredField, TracerParticles
from eddies.io.checkpoint import Checkpoint
from eddies.io.contiguous import Block
from eddies.parallel.migration import migrate
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.particle_set import ParticleSet
from eddies.scene.scene import Eulerian, Scene
from eddies.spectral.spectral_grid import SpectralGrid, restrict
from eddies.time_stepping import ETDRK4
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.rollout.particle_run import injection
from eddies.workflows.rollout.saved_rows import restored_rows, saved_rows

# Runaway is a flow with this many times the energy of its start.
RUNAWAY_ENERGY = 100.0


class EulerianRun:
    """The fluid of the scene on a coarse grid, with a Smagorinsky model or without one, from a frame of the truth on.

    It starts from those modes of the filtered velocity that the grid keeps, with the density in balance, so that the
    start makes no sound. The true particles follow the resolved velocity.
    """

    has_density = True

    def __init__(self, scene: Scene, truth: GroundTruth, start: int, directory: Path, device: torch.device) -> None:
        self.settings, self.longest_step = scene.eulerian or Eulerian(), scene.simulation.step
        comm, length = truth.decomposition.comm, truth.decomposition.length
        cells = self.settings.cells_for(scene.tracers.filter_width)
        grid = SpectralGrid(SlabDecomposition(comm, length, cells), scene.flow.precision)
        self.fluid = coarse_fluid(scene, truth, grid)
        self.stepper, self.clock = ETDRK4(self.fluid), Clock()
        self.step_limit = CourantLimit(grid, scene.time.courant, math.inf)
        velocity = resolved_velocity(truth, grid, start)
        self.state = np.concatenate([velocity, balanced_density(grid, velocity, self.fluid.sound_speed)[None]])
        self.largest_energy = RUNAWAY_ENERGY * quadratic_energy(self.fluid, self.state)
        columns = truth.particles(start)
        columns = migrate(grid.decomposition, {name: columns[name] for name in ("id", "position")})
        # A filter of no width: the resolved velocity is a filtered one already.
        self.tracers = TracerParticles(FilteredField(grid, 0.0, scene.tracers.interpolation), columns, self.state)
        self.flow_seconds: list[float] = []

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
        """The particles with the density of the fluid, and their acceleration."""
        columns = {**self.tracers.columns, "density": self.tracers.density(self.state)}
        return ParticleSet.from_numpy(columns), torch.from_numpy(self._acceleration())

    def _acceleration(self) -> np.ndarray:
        """du/dt + v.grad u (n, 3) at the particles: the rate of change of their velocity, exact but for the splines."""
        fluid, velocity = self.fluid, self.state[:3]
        change = (fluid.linear(self.state) + fluid.nonlinear(self.state))[:3]
        gradients = [gradient(fluid.grid, component) for component in velocity]
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
        return {"integrator": "etdrk4", "cells": grid.cells, "largest_wavenumber": grid.cutoff,
                "smagorinsky": self.settings.smagorinsky, **seconds}


def coarse_fluid(scene: Scene, truth: GroundTruth, grid: SpectralGrid) -> CompressibleFluid:
    """The fluid of a scene with the forcing of its particles and the model of what a coarse grid does not resolve."""
    flow, constant = scene.flow, (scene.eulerian or Eulerian()).smagorinsky
    forcing, subgrid = None, None
    if (forced := injection(scene, truth)) is not None:
        forcing = LinearForcing(grid, forced.injection_rate, forced.wavenumber)
    if constant > 0:
        subgrid = Smagorinsky(grid, constant, truth.scales.filter_width)
    return CompressibleFluid(grid, flow.viscosity, flow.sound_speed, forcing, subgrid)


def resolved_velocity(truth: GroundTruth, grid: SpectralGrid, frame: int) -> np.ndarray:
    """The modes (3, kz, ky, kx) that a grid keeps of the filtered velocity stored at a frame."""
    fields, slab = truth.fields, SlabDecomposition(grid.decomposition.comm, grid.decomposition.length,
                                                   truth.fields.cells)
    index = int(np.argmin(np.abs(fields.times - truth.times[frame])))
    fine = SpectralGrid(slab, grid.precision, (slab.planes - 1) // 2)
    velocity = truth.field(index, "velocity", slab).astype(fine.real)
    return restrict(fine, grid, fine.forward(velocity))
