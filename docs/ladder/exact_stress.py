"""An oracle: how well particles and grids follow the filtered flow if the hidden stress is exact. Takes minutes.

    .venv/bin/python docs/ladder/exact_stress.py runs/ladder

The flow stored in the run goes on without a force, as an incompressible one, for a turnover. At each step the exact
force of the hidden stress is computed from the whole flow, for each set of modes that follows. Then grids of 32^3 and
48^3 cells and the particles of the preset `resolved` run with this force, interpolated in time by cubic polynomials.
What remains is the error of reconstruction, of modes that are not there, and of stepping. Writes
../results/exact-stress.json.
"""

import argparse
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from mpi4py import MPI

import eddies
from eddies.flow.navier_stokes import IncompressibleFluid
from eddies.flow.subgrid import Closure, StressModel
from eddies.flow.tracers import FilteredField, TracerParticles, release
from eddies.parallel.halo import HaloError
from eddies.parallel.migration import IdOrder
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.flow_units import FlowUnits
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.model import LagrangianModel
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.particles.terms.resolved_forces import Pressure, Relaxation, Stress, Viscosity
from eddies.scene import terms as declared
from eddies.spectral.mode_operators import gaussian_transfer
from eddies.spectral.spectral_grid import SpectralGrid, regrid
from eddies.time_stepping import ETDRK4
from eddies.workflows.ground_truth.truth import GroundTruth, open_truth
from eddies.workflows.rollout.eulerian_run import initial_state

INTERVAL, DEFAULT = 0.0125, (2, 2)  # step of the whole flow; stored interval and step of those that follow, in it
CELLS, PER_SIDE, PERTURBATION = (32, 48), 16, 1e-6
TIMES = {"half": 0.5, "end": 1.0}
OUTPUT = Path(__file__).parents[1] / "results" / "exact-stress.json"
Modes = Callable[[float], np.ndarray]


class Series:
    """Modes that are stored at the times of the steps of the whole flow."""

    def __init__(self) -> None:
        self.rows: list[np.ndarray] = []

    def between(self, every: int) -> Modes:
        """Return the cubic interpolation in time that uses each `every`-th row only."""
        rows, spacing = self.rows[::every], every * INTERVAL

        def at(time: float) -> np.ndarray:
            first = min(max(math.floor(time / spacing + 1e-9) - 1, 0), len(rows) - 4)
            place, nodes = time / spacing - first, range(4)
            weights = [math.prod((place - m) / (n - m) for m in nodes if m != n) for n in nodes]
            return sum(weight * row for weight, row in zip(weights, rows[first:first + 4]))

        return at


class Exact(Closure):
    """The force of the exact stress at the four evaluations of a step of ETDRK4."""

    def __init__(self, force: Modes, step: float) -> None:
        self.force, self.step, self.time, self.stages = force, step, 0.0, iter(())

    def begin_step(self, velocity: np.ndarray) -> None:
        self.stages = iter((0.0, 0.5, 0.5, 1.0))

    def add(self, velocity: np.ndarray, tendency: np.ndarray) -> None:
        tendency += self.force(self.time + next(self.stages) * self.step)


class ExactForce(eddies.Term):
    """The force of the exact stress on particles, at the time of the evaluation."""

    Settings = declared.Viscosity  # it reads the resolved velocity, and gives an acceleration

    def __init__(self, flow: FlowUnits, force: Modes) -> None:
        super().__init__(declared.Viscosity(), flow)
        self.force, self.time = force, 0.0

    def forward(self, context) -> eddies.Rates:
        return eddies.Rates(force_modes=torch.from_numpy(self.force(self.time)).to(context.resolved.velocity))


class Timed(ParticleDynamics):
    """Dynamics that tell the term `exact` the time."""

    def rates_after(self, delay: float, particles: ParticleSet) -> eddies.Rates:
        if "exact" in self.model.terms:
            self.model.terms["exact"].time = self.time + delay
        return super().rates_after(delay, particles)


class Truth:
    """The whole flow over a turnover: filtered modes and exact forces for all that follow, and tracers."""

    def __init__(self, truth: GroundTruth) -> None:
        comm, reference = truth.decomposition.comm, truth.reference
        self.comm, self.scales = comm, truth.scales
        self.turnover, self.viscosity = reference["eddy_turnover_time"], truth.scales.viscosity
        self.fluid = IncompressibleFluid(self.grid_of(truth.states.cells * 3 // 2), self.viscosity)
        state = initial_state(truth, self.fluid, 0.0, truth.state_frames[0])
        self.steps = 8 * round(self.turnover / (8 * INTERVAL))  # halves are steps of each follower
        self.width = truth.scales.filter_width
        self.followers = {cells: IncompressibleFluid(self.grid_of(cells), self.viscosity) for cells in CELLS}
        self.dynamics = Timed(SlabDecomposition(comm, truth.decomposition.length, truth.decomposition.planes),
                              LagrangianModel({"pressure": Pressure(declared.Pressure(), self.units)}, self.units), 0.0)
        keys = (*CELLS, "particles")
        self.filtered, self.forces = {key: Series() for key in keys}, {key: Series() for key in keys}
        field = FilteredField(self.fluid.grid, self.width, "quintic", margin=2)
        self.tracers = TracerParticles(field, release(self.fluid.grid.decomposition, 1, PER_SIDE**3, "random"), state)
        self.start = {name: column.copy() for name, column in self.tracers.columns.items()}
        self._follow(state)

    @property
    def units(self) -> FlowUnits:
        return FlowUnits(self.scales, self.scales.filter_width, 60.0)

    def grid_of(self, cells: int) -> SpectralGrid:
        return SpectralGrid(SlabDecomposition(self.comm, 2 * np.pi, cells), "float64")

    def by_id(self, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        order = IdOrder(self.comm, columns["id"], PER_SIDE**3)
        return {name: order.apply(columns[name]) for name in ("position", "velocity")}

    def _follow(self, state: np.ndarray) -> None:
        stepper, self.frames = ETDRK4(self.fluid), {}
        for number in range(self.steps + 1):
            if number:
                state = stepper(state, INTERVAL)
                self.tracers.advance(state, INTERVAL)
            self._store(state)
            for name, share in TIMES.items():
                if number == round(share * self.steps):
                    self.frames[name] = self.by_id(self.tracers.columns)
            if number % 20 == 0 and self.comm.rank == 0:
                print(f"flow: step {number} of {self.steps}", flush=True)

    def _store(self, state: np.ndarray) -> None:
        fine = self.fluid.grid
        transfer = gaussian_transfer(fine.wavenumber_squared, self.width)
        velocity, change = transfer * state, transfer * self.fluid.nonlinear(state)
        resolution = self.dynamics.resolution.grid
        for key in self.forces:
            grid = resolution.spectral if key == "particles" else self.followers[key].grid
            kept, whole = regrid(fine, grid, velocity), regrid(fine, grid, change)
            if key == "particles":
                kept = as_numpy(resolution.within(torch.from_numpy(kept)))
                products = resolution.squares(torch.from_numpy(kept))
                own = -as_numpy(resolution.solenoidal(resolution.stress_divergence(products)))
                force = as_numpy(resolution.within(torch.from_numpy(whole - own)))
            else:
                force = whole - self.followers[key].nonlinear(kept)
            self.filtered[key].rows.append(kept)
            self.forces[key].rows.append(force)

    def errors(self, name: str, columns: dict[str, np.ndarray], modes: np.ndarray, key, grid: SpectralGrid) -> dict:
        """Relative errors of the velocities of the particles and of the modes at half or at the end."""
        exact, found = self.frames[name], self.by_id(columns)
        missed, whole = global_sum(self.comm, [float(((found["velocity"] - exact["velocity"])**2).sum()),
                                               float((exact["velocity"]**2).sum())])
        true = self.filtered[key].rows[round(TIMES[name] * self.steps)]
        square = [grid.sum_modes((np.abs(part)**2).sum(0)) for part in (modes - true, true)]
        return {f"particles_{name}": math.sqrt(missed / whole), f"modes_{name}": math.sqrt(square[0] / square[1])}


def on_grid(truth: Truth, cells: int, every: int, steps: int, closure: Closure | None = None,
            perturbed: float = 0.0) -> tuple[dict, np.ndarray]:
    """Errors on a grid that uses each `every`-th force and takes steps of `steps` intervals, and its last modes."""
    grid, step = truth.followers[cells].grid, steps * INTERVAL
    closure = closure or Exact(truth.forces[cells].between(every), step)
    fluid = IncompressibleFluid(grid, truth.viscosity, closure=closure)
    stepper, state = ETDRK4(fluid), truth.filtered[cells].rows[0] * (1 + perturbed)
    tracers, errors = TracerParticles(FilteredField(grid, 0.0, "quintic", margin=2), truth.start, state), {}
    for number in range(truth.steps // steps):
        closure.begin_step(state)
        closure.time = number * step
        with np.errstate(over="ignore", invalid="ignore"):
            state = stepper(state, step)
        try:
            tracers.advance(state, step)
        except HaloError:  # the flow has become unstable
            return errors | {"unstable_after": number * step / truth.turnover}, state
        for name, share in TIMES.items():
            if (number + 1) * steps == round(share * truth.steps):
                errors |= truth.errors(name, tracers.columns, state, cells, grid)
    return errors, state


@torch.no_grad()
def with_particles(truth: Truth, every: int, steps: int, form: str, integrator: str = "rk3") -> dict:
    """Errors of particles. `form`: "exact" stress; "relaxed", with the relaxation of `resolved` beside it; "model", the
    stress of `resolved` in its place."""
    units, dynamics, step = truth.units, truth.dynamics, steps * INTERVAL
    terms = {"pressure": Pressure(declared.Pressure(), units), "viscosity": Viscosity(declared.Viscosity(), units),
             "exact": ExactForce(units, truth.forces["particles"].between(every))}
    if form != "exact":
        terms["relaxation"] = Relaxation(declared.Relaxation(), units)
    if form == "model":
        del terms["exact"]
        terms["stress"] = Stress(declared.Stress(), units)
    dynamics.model = LagrangianModel(terms, units)
    dynamics.begin()
    scheme, errors = INTEGRATORS[integrator](dynamics), {}
    particles = ParticleSet.from_numpy(truth.start)
    for number in range(truth.steps // steps):
        particles = scheme.step(particles, step)
        for name, share in TIMES.items():
            if (number + 1) * steps == round(share * truth.steps):
                modes = as_numpy(dynamics.resolution.of(particles, dynamics.time).modes)
                grid = dynamics.resolution.grid.spectral
                errors |= truth.errors(name, particles.to_numpy(), modes, "particles", grid)
    return errors


def main(run: Path) -> None:
    with open_truth(MPI.COMM_WORLD, run / "ground_truth.h5") as file:
        truth = Truth(file)
    every, steps = DEFAULT
    found = {"turnover": truth.turnover, "filter_width_over_eta": truth.width / truth.scales.kolmogorov_length}
    for cells in CELLS:
        exact, end = on_grid(truth, cells, every, steps)
        _, other = on_grid(truth, cells, every, steps, perturbed=PERTURBATION)
        grid = truth.followers[cells].grid
        apart, whole = (math.sqrt(grid.sum_modes((np.abs(part)**2).sum(0))) for part in (other - end, end))
        found[f"{cells}^3 cells"] = {
            "exact stress": exact, "half the stored interval": on_grid(truth, cells, every // 2, steps)[0],
            "twice the stored interval": on_grid(truth, cells, 2 * every, steps)[0],
            "half the step": on_grid(truth, cells, every, steps // 2)[0],
            "no stress": on_grid(truth, cells, every, steps, Still())[0],
            "gradient model": on_grid(truth, cells, every, steps, StressModel(grid, filter_width=truth.width))[0],
            "growth of a perturbation": apart / whole / PERTURBATION}
    found["particles"] = {
        "exact stress": with_particles(truth, every, steps, "exact"),
        "half the stored interval": with_particles(truth, every // 2, steps, "exact"),
        "half the step": with_particles(truth, every, steps // 2, "exact"),
        "exact stress and relaxation": with_particles(truth, every, steps, "relaxed"),
        "relaxation, half the step": with_particles(truth, every, steps // 2, "relaxed"),
        "stress of resolved and relaxation": with_particles(truth, every, steps, "model")}
    if truth.comm.rank == 0:
        OUTPUT.write_text(json.dumps(found, indent=1) + "\n")
        for name, rows in found.items():
            if isinstance(rows, dict):
                for case, errors in rows.items():
                    shown = errors if isinstance(errors, float) else "  ".join(
                        f"{key} {value:.2e}" for key, value in errors.items())
                    print(f"{name}, {case}: {shown}")


class Still(Closure):
    """No stress."""

    def add(self, velocity: np.ndarray, tendency: np.ndarray) -> None:
        pass


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    main(parser.parse_args().run)
