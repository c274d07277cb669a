"""Oracles of the ladder, from its run: the true density at each step, and two errors of one force. Takes minutes.

    .venv/bin/python docs/ladder/oracles.py runs/ladder runs/choices

The force of `density-constant`, which has no equation for the density, is evaluated with the true density at the places
of the particles, or with that of the same particle in the truth. For all trained rungs the error of the acceleration at
single moments of unseen flows is split into a solenoidal and a compressive part: the second gathers particles. Writes
../results/ladder-oracles.json, where rungs that are not trained keep what is there.
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from mpi4py import MPI

from eddies.analysis.disorder import count_variance
from eddies.analysis.errors import fluctuations, normalized_l2, velocity_error
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.fourier_grid import FourierGrid
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.scene.scene import Scene, load_scene
from eddies.spectral.interpolation import SplineInterpolation
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.workflows.ground_truth.truth import GroundTruth, open_truth
from eddies.workflows.learned.model import particles_for
from eddies.workflows.rollout.method import ParticleRun, TimeStep, make_method

STEP, MOMENTS, TESTS, STEADY = TimeStep("corrected-verlet", 0.05), 6, (4, 5), "density-constant"
CELLS = 12  # of the grid on which errors are averaged: 2.4 particles a cell
OUTPUT = Path(__file__).parents[1] / "results" / "ladder-oracles.json"
Density = Callable[[float, ParticleSet], np.ndarray]


class AtPlaces:
    """The true density (n,) at the places of particles, of the stored fields: cubic in space, linear in time."""

    def __init__(self, truth: GroundTruth) -> None:
        slab = SlabDecomposition(MPI.COMM_SELF, truth.decomposition.length, truth.fields.cells)
        grid = SpectralGrid(slab, "float64", (slab.planes - 1) // 2)
        self.times, self.spline = truth.fields.times, SplineInterpolation(grid, "cubic", 1)
        self.rows = [self.spline.coefficients(grid.forward(truth.planes(truth.fields, index, "density", slab)))
                     for index in range(len(self.times))]

    def __call__(self, time: float, particles: ParticleSet) -> np.ndarray:
        index = min(int(np.searchsorted(self.times, time, side="right")), len(self.times) - 1)
        share = (time - self.times[index - 1]) / (self.times[index] - self.times[index - 1])
        early, late = (self.spline.at(self.rows[row], as_numpy(particles.position))[:, 0] for row in (index - 1, index))
        return (1 - share) * early + share * late


class OfParticles:
    """The true density (n,) of the same particles in the truth, linear in time."""

    def __init__(self, truth: GroundTruth) -> None:
        self.truth = truth

    def __call__(self, time: float, particles: ParticleSet) -> np.ndarray:
        times = self.truth.times
        index = min(int(np.searchsorted(times, time, side="right")), len(times) - 1)
        share = (time - times[index - 1]) / (times[index] - times[index - 1])
        early, late = (self.truth.block(row, ("density",))["density"] for row in (index - 1, index))
        return ((1 - share) * early + share * late)[as_numpy(particles.id)]


def with_density(run: ParticleRun, density: Density) -> None:
    """Make the forces of a rollout read this density in place of that of the particles."""
    evaluate = run.dynamics.rates_after

    def rates_after(delay: float, particles: ParticleSet):
        known = torch.from_numpy(density(run.time + delay, particles))
        return evaluate(delay, replace(particles, density=known.to(particles.density)))

    run.dynamics.rates_after = rates_after


@torch.no_grad()
def rollout(scene: Scene, directory: Path, truth: GroundTruth, density: Density | None) -> dict[str, float]:
    """Errors of a rollout over a turnover."""
    run = make_method(scene, STEP, truth, 0, directory)
    if density is not None:
        with_density(run, density)
    found, number = {}, 0
    turnover = truth.reference["eddy_turnover_time"]
    for name, frame in (("half", int(0.5 * turnover / truth.times[1])), ("end", int(turnover / truth.times[1]))):
        while run.time < truth.times[frame] - 1e-9:
            number += 1
            fault = run.advance(float(truth.times[frame]), number)
            if fault is not None:
                return found | {"broken": run.time / turnover}
        columns = run.particles.to_numpy()
        order, exact = np.argsort(columns["id"]), truth.block(frame)
        velocity = columns["velocity"][order]
        found |= {f"velocity_error_{name}": velocity_error(velocity, exact["velocity"]),
                  f"energy_{name}": float(np.sum(fluctuations(velocity)**2)
                                          / np.sum(fluctuations(exact["velocity"])**2)),
                  f"counts_{name}": count_variance(columns["position"], truth.decomposition.length)}
    return found


@torch.no_grad()
def two_errors(scene: Scene, directory: Path, truth: GroundTruth) -> dict[str, float]:
    """The error of the acceleration, and the share of the square of its average over neighbours that is compressive.

    The share is 1/3 for errors that are independent from particle to particle, and 0 for a solenoidal error.
    """
    run, errors, shares = make_method(scene, STEP, truth, 0, directory), [], []
    slab = SlabDecomposition(MPI.COMM_SELF, truth.decomposition.length, CELLS)
    grid = FourierGrid(slab, CELLS // 2 - 1)
    for frame in np.linspace(1, len(truth.times) - 2, MOMENTS).astype(int):
        columns = truth.particles_with_rates(frame)
        exact = torch.from_numpy(columns.pop("acceleration"))
        columns.pop("density_rate", None)
        run.dynamics.forget()
        found = run.dynamics.rates(particles_for(run.model, columns, exact.device)).acceleration
        errors.append(normalized_l2(as_numpy(found), as_numpy(exact)))
        points = grid.points(torch.from_numpy(columns["position"]))
        rows = torch.cat([found.double() - exact, torch.ones(len(exact), 1, dtype=torch.float64)], 1)
        sums = points.spread(rows)
        modes = grid.within(grid.to_modes(sums[:3] / sums[3:]))
        whole = float(grid.mean_square(modes, 0))
        shares.append(1 - float(grid.mean_square(grid.solenoidal(modes), 0)) / whole)
    return {"acceleration_error": float(np.mean(errors)), "compressive_share": float(np.mean(shares))}


def main(ladder: Path, runs: list[Path]) -> None:
    found = json.loads(OUTPUT.read_text(encoding="utf-8"))
    tests = [ladder / f"realisation-{seed}" / "ground_truth.h5" for seed in TESTS]
    models = {(run, name): own for run in [ladder, *runs]
              for name, own in load_scene(run / "scene.toml").variant.items() if (run / name / "model.h5").exists()}
    for run, name in models:
        found["errors"].setdefault(run.name, {})[name] = []
    if (ladder, STEADY) in models:
        found["density"] = {}
    for path in tests:
        with open_truth(MPI.COMM_SELF, path) as truth:
            for (run, name), own in models.items():
                found["errors"][run.name][name].append(two_errors(own, run / name, truth))
            if (ladder, STEADY) in models:
                for case, made in (("own", None), ("at the places", AtPlaces), ("of the particles", OfParticles)):
                    row = rollout(models[ladder, STEADY], ladder / STEADY, truth, made and made(truth))
                    found["density"].setdefault(case, []).append(row)
    OUTPUT.write_text(json.dumps(found, indent=1) + "\n")
    for of, rows in [*found["errors"].items(), ("density", found["density"])]:
        for name, each in rows.items():
            means = {key: round(float(np.mean([row[key] for row in each])), 4)
                     for key in each[0] if all(key in row for row in each)}
            print(f"{of}, {name}: {means}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ladder", type=Path)
    parser.add_argument("runs", type=Path, nargs="*", help="further runs with trained variants, such as runs/choices")
    given = parser.parse_args()
    main(given.ladder, given.runs)
