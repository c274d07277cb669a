"""Rollouts by Eulerian large-eddy simulation on a coarse grid. Particles follow the filtered velocity of the flow."""

import math
import time
from typing import Any

import numpy as np
import torch

from eddies.clock import Clock, rounded_up
from eddies.flow.stability import CourantLimit, quadratic_energy
from eddies.flow.forcing import LinearForcing
from eddies.flow.initial_fields import balanced_density
from eddies.flow.navier_stokes import FLUIDS, Fluid
from eddies.flow.subgrid import Closure, DynamicStress, EddyDamping, SpectralViscosity, StressModel
from eddies.flow.tracers import FilteredField, TracerParticles
from eddies.io.checkpoint import Checkpoint
from eddies.io.flow_states import restored_modes, saved_modes
from eddies.parallel.migration import migrate
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.particles.resolved_velocity import ResolvedVelocity
from eddies.scene.scene import Eulerian, Flow, SceneError
from eddies.scene.terms import Forcing
from eddies.spectral.mode_operators import gaussian_transfer
from eddies.spectral.spectral_grid import SpectralGrid, regrid
from eddies.time_stepping import ETDRK4
from eddies.workflows.ground_truth.flow_run import restored_rows, saved_rows
from eddies.workflows.ground_truth.truth import GroundTruth

# A flow is unstable if its energy is more than this factor times its initial energy.
RUNAWAY_ENERGY = 100.0


class EulerianRun:
    """A large-eddy simulation that starts at a frame of the truth: a fluid on a coarse grid, with or without a closure.

    The initial state has those modes of the unfiltered velocity that the grid can hold. They are read from the true
    flow, or found from the velocities of the particles. If the equations are for the filtered velocity, these modes are
    filtered first. The particles always follow the filtered velocity.

    Parameters
    ----------
    fluid : the fluid on the coarse grid.
    start : number of the frame.
    longest_step, courant : largest time step, and largest Courant number.
    interpolation : the splines that interpolate from the grid to the particles.
    """

    def __init__(self, settings: Eulerian, fluid: Fluid, truth: GroundTruth, start: int, longest_step: float,
                 courant: float, interpolation: str) -> None:
        self.settings, self.fluid, self.longest_step = settings, fluid, longest_step
        grid = fluid.grid
        # Width of the filter that the fluid's velocity has passed. Width of the filter that must still be applied to
        # this velocity, because particles follow the filtered one.
        filter_passed = filter_of(settings, truth)
        filter_left = 0.0 if filter_passed else truth.scales.filter_width
        self.stepper, self.clock = ETDRK4(fluid), Clock()
        self.step_limit = CourantLimit(grid, courant, math.inf)
        state_of = {"flow": initial_state, "particles": state_of_particles}[settings.start]
        self.state = state_of(truth, fluid, filter_passed, start)
        self.largest_energy = RUNAWAY_ENERGY * quadratic_energy(fluid, self.state)
        columns = truth.particles(start)
        columns = migrate(grid.decomposition, {name: columns[name] for name in ("id", "position")})
        field = FilteredField(grid, filter_left, interpolation, margin=math.ceil(courant))
        self.tracers = TracerParticles(field, columns, self.state)
        self.flow_seconds: list[float] = []

    @property
    def has_density(self) -> bool:
        """Whether the particles of a frame have a density."""
        return self.fluid.compressible

    @property
    def time(self) -> float:
        """Time of the flow since the start."""
        return self.clock.time

    def advance(self, until: float, number: int) -> str | None:
        """Divide the time left to `until` into equal steps and take the first one, the step with this `number`.

        The step is limited by the Courant number of the present flow and by [simulation] step. Returns a text that
        describes the fault of the new state, or None if there is no fault; the result is the same on all ranks.
        """
        left = until - self.time
        longest = min(self.step_limit.bound(self.state, self.clock), self.longest_step)
        step = left / rounded_up(left / longest)
        began = time.perf_counter()
        with np.errstate(over="ignore", invalid="ignore"):  # the test of the energy below reports it
            if self.fluid.closure is not None:
                self.fluid.closure.begin_step(self.state[:3])
            self.state = self.stepper(self.state, step)
            energy = quadratic_energy(self.fluid, self.state)
        self.flow_seconds.append(time.perf_counter() - began)
        # A NaN fails this condition too.
        if not energy <= self.largest_energy:
            return (f"step {number}: the coarse flow is unstable: its energy {energy:.3g} is more than "
                    f"{RUNAWAY_ENERGY:g} times that of the start; lower [time] courant or [simulation] step")
        self.clock.tick(step)
        self.tracers.advance(self.state, step)
        return None

    def frame(self, time: float) -> tuple[ParticleSet, torch.Tensor]:
        """Return the particles and their acceleration (n, 3). The particles of a compressible fluid have a density.

        The acceleration is du/dt + v.grad u, with the filtered velocity u and the velocity v of the particle. Its only
        error is that of the splines.
        """
        density = {"density": self.tracers.density(self.state)} if self.has_density else {}
        fluid, transfer = self.fluid, self.tracers.field.transfer
        velocity = transfer * self.state[:3]
        if fluid.closure is not None:
            fluid.closure.begin_step(self.state[:3])
        change = transfer * (fluid.linear(self.state) + fluid.nonlinear(self.state))[:3]
        gradients = [fluid.grid.gradient(component) for component in velocity]
        spline = self.tracers.field.spline
        values = spline.at(spline.coefficients(np.concatenate([change, *gradients])), self.tracers.columns["position"])
        along = np.einsum("nij,nj->ni", values[:, 3:].reshape(-1, 3, 3), self.tracers.columns["velocity"])
        return ParticleSet.from_numpy(self.tracers.columns | density), torch.from_numpy(values[:, :3] + along)

    def status(self) -> str:
        """Return an empty text, because the progress line shows nothing special of this method."""
        return ""

    def series(self) -> dict[str, dict[str, list[float]]]:
        """Return no tables."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a checkpoint; collective."""
        grid = self.fluid.grid
        return {"modes": saved_modes(grid, self.state), "clock": self.clock.state_dict(),
                "flow_seconds": self.flow_seconds,
                **saved_rows(grid.decomposition.comm, self.tracers.columns)}

    def load_state_dict(self, saved: Checkpoint) -> None:
        """Restore a state of `state_dict`; collective. The continued run is exact on the same number of ranks."""
        grid = self.fluid.grid
        self.state = restored_modes(grid, saved, 4)
        self.clock.load_state_dict(saved["clock"])
        self.flow_seconds = saved["flow_seconds"]
        columns, _ = restored_rows(grid.decomposition, saved)
        self.tracers = TracerParticles(self.tracers.field, columns, self.state)

    def description(self) -> dict[str, float | str]:
        """Return the attributes of the product that describe the grid, the fluid and the closure.

        If a step was taken, there is also `flow_seconds_per_step`, the median wall seconds of a step of the flow alone,
        without the particles.
        """
        grid = self.fluid.grid
        seconds = {"flow_seconds_per_step": float(np.median(self.flow_seconds))} if self.flow_seconds else {}
        key = self.settings.form.constant
        constant = f", C_s = {getattr(self.settings, key):g}" if key else ""
        return {"integrator": "etdrk4", "cells": grid.cells, "largest_wavenumber": grid.cutoff,
                "fluid": self.settings.fluid, "equations": self.settings.equations,
                "closure": self.settings.closure + constant, "start": self.settings.start, **seconds}


def coarse_fluid(settings: Eulerian, flow: Flow, precision: str, forcing: Forcing | None, truth: GroundTruth,
                 damping: np.ndarray | None) -> Fluid:
    """Make the fluid on its coarse grid, with its forcing and its closure. `damping` has the rates of a learned
    closure, see `EddyDamping`."""
    slab, width = truth.decomposition, truth.scales.filter_width
    grid = SpectralGrid(SlabDecomposition(slab.comm, slab.length, settings.cells_for(width)), precision)
    filter_passed = filter_of(settings, truth)
    forced = forcing and LinearForcing(grid, forcing.injection_rate, forcing.wavenumber, filter_passed)
    sound_speed = flow.sound_speed if settings.compressible else math.inf
    closure = closure_of(settings, grid, filter_passed, damping)
    return FLUIDS[settings.fluid](grid, flow.viscosity, sound_speed, forced, closure=closure)


def filter_of(settings: Eulerian, truth: GroundTruth) -> float:
    """Return the width of the filter that the velocity in the equations has passed: that of the truth, or 0 if the
    velocity is unfiltered."""
    return truth.scales.filter_width if settings.equations == "filtered" else 0.0


def closure_of(settings: Eulerian, grid: SpectralGrid, filter_width: float,
               damping: np.ndarray | None) -> Closure | None:
    """Return the closure of the equations for a velocity that has passed a filter of the width `filter_width`.

    The width is 0 if the only filter is the sharp cut-off of the grid at its highest wavenumber k_c. Smagorinsky's
    length Delta is the width, or pi/k_c if the width is 0. `damping` is as in `coarse_fluid`.
    """
    width = filter_width or math.pi / grid.cutoff
    made = {
        "none": lambda: None,
        "smagorinsky": lambda: StressModel(grid, mixing_length=settings.smagorinsky * width),
        "dynamic-smagorinsky": lambda: DynamicStress(grid, filter_width),
        "spectral": lambda: SpectralViscosity(grid),
        "learned": lambda: EddyDamping(grid, damping),
        "gradient": lambda: StressModel(grid, filter_width=filter_width),
        "dynamic-mixed": lambda: DynamicStress(grid, filter_width, with_gradient=True),
    }
    return made[settings.closure]()


def initial_state(truth: GroundTruth, fluid: Fluid, filter_passed: float, frame: int) -> np.ndarray:
    """Return the modes of the true flow at a frame, on the grid of `fluid`. The velocity is filtered with the width
    `filter_passed`; 0 means no filter.

    For a compressible fluid the state has a density, too. Without a filter, the density is that of the true flow. With
    a filter, it is in balance with the filtered velocity. Raises SceneError if the unfiltered flow is not stored at the
    frame.
    """
    grid, series = fluid.grid, truth.states
    if frame not in truth.state_frames:
        stored = ", ".join(f"{time / truth.times[-1]:.3g}" for time in series.times)
        remedy = f"only at {stored}; set [simulation] start to one of these, or" if stored else "at no time;"
        raise SceneError(
            f'[simulation] method = "eulerian": the rollout starts at {truth.times[frame] / truth.times[-1]:.3g} of the'
            f" ground truth, which holds the unfiltered flow {remedy} remove ground_truth.h5 and run `eddies dns` "
            "with this start")
    slab = SlabDecomposition(grid.decomposition.comm, grid.decomposition.length, series.cells)
    whole = SpectralGrid(slab, grid.precision, (series.cells - 1) // 2)

    def stored_planes(variable: str) -> np.ndarray:
        return truth.planes(series, truth.state_frames.index(frame), variable, slab)

    def kept(values: np.ndarray) -> np.ndarray:
        return regrid(whole, grid, whole.forward(values.astype(whole.real)))

    velocity = kept(stored_planes("velocity"))
    velocity *= gaussian_transfer(grid.wavenumber_squared, filter_passed).astype(grid.real)
    if not fluid.compressible:
        return grid.solenoidal(velocity)
    if filter_passed:
        return np.concatenate([velocity, balanced_density(grid, velocity, fluid.sound_speed)[None]])
    return np.concatenate([velocity, kept(np.log(stored_planes("density")))])


@torch.no_grad()
def state_of_particles(truth: GroundTruth, fluid: Fluid, filter_passed: float, frame: int) -> np.ndarray:
    """Return the modes of the flow that least squares find from the velocities of the true particles at a frame
    (`ResolvedVelocity`). Modes that the particles do not resolve are zero.

    If `filter_passed` is 0, the filter of the particles' velocity is undone. For a compressible fluid the state has a
    density, which is in balance with the velocity.
    """
    solver, grid = ResolvedVelocity.on_slabs(truth.decomposition, truth.scales), fluid.grid
    resolved = solver.of(ParticleSet.from_numpy(truth.particles(frame)))
    modes = resolved.velocity if filter_passed else resolved.unfiltered
    velocity = regrid(resolved.grid.spectral, grid, as_numpy(resolved.grid.with_mean(modes, resolved.mean)))
    if not fluid.compressible:
        return velocity
    return np.concatenate([velocity, balanced_density(grid, velocity, fluid.sound_speed)[None]])
