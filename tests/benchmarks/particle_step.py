"""Time of an evaluation of a particle model in a rollout, and of its parts.

    mpirun -n 2 .venv/bin/python -m mpi4py tests/benchmarks/particle_step.py [PARTICLES A SIDE] [--model NAME]
        [--threads T] [--precision float64]

A model of any preset with initial weights, and the damping learned in hit-small, moves random particles in a solenoidal
velocity with a turbulent spectrum, filtered at two particle spacings. Steps have the length of a rollout; ten steps
warm up. Prints a JSON line with medians over the steps: seconds per evaluation of the slowest rank and of each part,
iterations of a solve (null without solves), and evaluations and seconds per turnover of the field.
"""

import argparse
import json
import math
import os
import time
from collections import Counter
from statistics import median

import numpy as np
import torch
from mpi4py import MPI
from step import Stopwatch

from eddies.flow.initial_fields import velocity_of_spectrum
from eddies.flow.statistics import energy_spectrum, turbulence_scales
from eddies.flow.tracers import release
from eddies.cores import threads
from eddies.kernels.library import library
from eddies.kernels.modes import ModePasses
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.context import Context
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.flow_units import (FlowUnits, ReferenceScales, allowed_step, planes_for,
                                         resolved_wavenumber)
from eddies.particles.fourier_grid import Points
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.least_squares import LeastSquares
from eddies.particles.model import build_model
from eddies.particles.neighborhood import Neighborhood
from eddies.particles.resolved_velocity import ResolvedVelocity
from eddies.scene.sections import Tracers
from eddies.scene.terms import PRESETS, TERMS, StepUnits
from eddies.spectral.interpolation import SplineInterpolation
from eddies.spectral.mode_operators import gaussian_transfer
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.workflows.learned.model import particles_for

WARM_UP, STEPS, INTEGRATOR, NEIGHBORS = 10, 6, "rk3", 60.0
DAMPING = (0.0, 0.0, 0.01, 0.14, 1.0, 1.6)
PAIR_SHARE = 0.03  # of the acceleration, about the share of a trained network; a larger one makes the flow unstable
ETA = 1.5
PARTS = {
    "transforms": [(SpectralGrid, name) for name in ("forward", "backward", "squares")],
    "splines": [(Points, "at"), (Points, "spread"), (SplineInterpolation, "with_ghosts")],
    "vectors": [(ModePasses, name) for name in ("apply", "descend", "update_direction")],
    "solve, the rest": [(LeastSquares, "solve")],
    "closure, the rest": [(ResolvedVelocity, "of"), (ResolvedVelocity, "remember")],
    "pairs": [(Context, "sum_pairs"), (Neighborhood, "update")],
    "settle": [(ParticleDynamics, "settle")],
}


def filtered_velocity(comm: MPI.Comm, side: int, width: float) -> tuple[SpectralGrid, np.ndarray]:
    """A grid of two cells per particle and direction, and filtered modes; rms 1 per component before the filter."""
    grid, k = SpectralGrid(SlabDecomposition(comm, 2 * math.pi, 2 * side), cutoff=side - 1), np.arange(1.0, side)
    # With the dissipation range of a simulation with k_max eta = ETA (Pope 2000, beta = 5.2).
    energy = k ** (-5 / 3) * np.exp(-5.2 * ETA * k / side)
    modes = velocity_of_spectrum(grid, 1, k, 1.5 * energy / energy.sum())
    return grid, gaussian_transfer(grid.wavenumber_squared, width) * modes


class Run:
    """Particles and the model that moves them."""

    def __init__(self, comm: MPI.Comm, side: int, model: str, precision: str) -> None:
        tracers = Tracers(particles_per_side=side, turnovers=1.0, frame_interval=1.0)
        width = 2 * tracers.spacing
        grid, modes = filtered_velocity(comm, side, width)
        scales = turbulence_scales(energy_spectrum(grid, modes), 0.0, 0.0, grid.cutoff)
        self.speed, self.turnover = scales["velocity_rms"], scales["eddy_turnover_time"]
        slab = SlabDecomposition(comm, 2 * math.pi, planes_for(tracers.particles))
        columns = release(slab, 1, side**3, "random")
        # The slabs of particles and field have different boundaries.
        spline = SplineInterpolation(grid, "quintic", margin=2)
        columns["velocity"] = spline.at(spline.coefficients(modes), columns["position"])
        columns["density"] = np.ones(len(columns["id"]))
        scales = ReferenceScales(filter_width=width, spacing=tracers.spacing, velocity=self.speed,
                                 acceleration=self.speed / self.turnover, density_mean=1.0, density=1e-3,
                                 density_rate=1e-3 / self.turnover, sound_speed=10 * self.speed, viscosity=1e-3,
                                 kolmogorov_length=ETA / side)
        radius = tracers.radius_of(NEIGHBORS)
        dtype, terms = getattr(torch, precision), PRESETS[model]
        settings = {word: TERMS[word](**chosen) for word, chosen in terms.items()}
        built = build_model(settings, terms, FlowUnits(scales, radius, NEIGHBORS)).to(dtype)
        if "damping" in built.terms:
            built.terms["damping"].rates.copy_(torch.tensor(DAMPING))
        for term in built.networks:
            term.network.weights[-1].mul_(PAIR_SHARE)
        self.particles = particles_for(built, columns, torch.device("cpu"))
        self.dynamics = ParticleDynamics(slab, built, 0.0, dtype)
        self.integrator = INTEGRATORS[INTEGRATOR](self.dynamics)
        units = StepUnits(radius=radius, filter_width=width, sound_speed=scales.sound_speed, velocity=self.speed,
                          scheme=self.integrator.scheme)
        self.longest = min(each.longest_step(units) for each in settings.values())  # that the terms allow
        self.highest = int(resolved_wavenumber(tracers.spacing, width, scales.kolmogorov_length))

    @property
    def step(self) -> float:
        """The longest step that the flow and the terms allow."""
        speed = self.dynamics.resolution.speed if self.dynamics.resolution else 0.0
        return min(self.longest, allowed_step(self.integrator.scheme.angle, self.highest, speed or self.speed))

    def advance(self) -> None:
        """Take a step."""
        self.particles = self.integrator.step(self.particles, self.step)


def measure(comm: MPI.Comm, run: Run) -> dict[str, object]:
    """Medians over steps of the seconds of the slowest rank."""
    watch = Stopwatch()
    for part, functions in PARTS.items():
        for owner, name in functions:
            watch.wrap(owner, name, part)
    found: list[Counter] = []
    for number in range(WARM_UP + STEPS):
        run.dynamics.evaluations, solves = 0, []
        if run.dynamics.resolution is not None:
            run.dynamics.resolution.solves = solves
        comm.Barrier()
        watch.reset()
        watch.last = start = time.perf_counter()
        run.advance()
        watch.switch()
        seconds = Counter({part: comm.allreduce(watch.seconds[part], MPI.MAX) for part in (*PARTS, "the rest")})
        seconds["whole"] = comm.allreduce(time.perf_counter() - start, MPI.MAX)
        taken = Counter({name: value / run.dynamics.evaluations for name, value in seconds.items()})
        if solves:
            taken["iterations"] = np.mean([solve[0] for solve in solves])
        if number >= WARM_UP:
            found.append(taken)
    medians = {name: float(median(step[name] for step in found)) for name in found[0]}
    whole, evaluations = medians.pop("whole"), run.dynamics.evaluations * run.turnover / run.step
    return {"seconds_per_evaluation": whole, "iterations": medians.pop("iterations", None),
            "evaluations_per_turnover": evaluations, "seconds_per_turnover": whole * evaluations, "parts": medians}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("side", nargs="?", type=int, default=64)
    parser.add_argument("--model", choices=PRESETS, default="resolved")
    parser.add_argument("--threads", type=int, default=threads(), help="per rank; default OMP_NUM_THREADS")
    parser.add_argument("--precision", choices=("float32", "float64"), default="float32")
    options, comm = parser.parse_args(), MPI.COMM_WORLD
    os.environ["OMP_NUM_THREADS"] = str(options.threads)  # for libraries and plans from here on
    for runtime in (torch.set_num_threads, library().omp_set_num_threads):
        runtime(options.threads)
    with torch.no_grad():
        run = Run(comm, options.side, options.model, options.precision)
        found = measure(comm, run)
    if comm.rank == 0:
        print(json.dumps({"particles": options.side, "ranks": comm.size, "threads": options.threads,
                          "model": options.model, "precision": options.precision, **found}))


if __name__ == "__main__":
    main()
