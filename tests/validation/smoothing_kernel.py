"""Best possible averages over neighbours, and moving least squares with as many, of a filtered field. A script.

    python tests/validation/smoothing_kernel.py RUN [RUN ...] [--neighbors 60] [--steps 60]

On the last field of each ground truth, normalised errors of velocity and gradient at random grid points: of the usual
kernels; of the kernel of all that are nowhere negative which is best on these very points, for velocity, gradient, or
both, found as a table of 17 values; of moving least squares, linear and quadratic, with Wendland's weights. Prints a
line for each.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from mpi4py import MPI

from eddies.io.hdf5 import open_product
from eddies.kernels.library import library
from eddies.kernels.neighbors import Box
from eddies.kernels.reconstruction import fitted as fitted_by
from eddies.kernels.reconstruction import kernel_numbers
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.neighbor_list import NeighborList
from eddies.particles.particle_field import grid_points
from eddies.particles.periodic_box import PeriodicBox
from eddies.particles.smoothing_kernels import CubicSpline, HermiteKernel, WendlandC2
from eddies.scene.scene import BOX_LENGTH
from eddies.scene.sections import Tracers
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.train_kernel import load_sample

KNOTS, POINTS, TOGETHER = 17, 8192, 1024
# Weights of velocity and gradient in what the best table minimises.
AIMS = {"velocity": (1.0, 0.0), "gradient": (0.0, 1.0), "both": (1.0, 1.0)}
DEGREES = {"linear": 1, "quadratic": 2}
LEAST_WEIGHT = 1e-8  # the ridge: points with too few neighbours stay solvable


class Field:
    """Particles in a filtered field, and random grid points at which it is known."""

    def __init__(self, path, neighbors, seed=1):
        with open_product(MPI.COMM_SELF, Path(path) / "ground_truth.h5", "ground_truth") as file:
            truth = GroundTruth(file, SlabDecomposition(MPI.COMM_SELF, BOX_LENGTH, 8))
            slab = SlabDecomposition(MPI.COMM_SELF, BOX_LENGTH, truth.fields.cells)
            side = round(truth.total ** (1 / 3))
            self.support = Tracers(particles_per_side=side, turnovers=1.0, frame_interval=1.0).radius_of(neighbors)
            truth = GroundTruth(file, slab)
            last = len(truth.fields.times) - 1
            self.sample = load_sample(truth, last, self.support)
            columns = truth.block(truth.at_fields[last], ("position", "velocity"))
            self.position, self.velocity = (torch.from_numpy(columns[name]) for name in ("position", "velocity"))
        chosen = np.random.default_rng(seed).choice(slab.planes**3, min(POINTS, slab.planes**3), replace=False)
        self.rows = torch.from_numpy(np.sort(chosen))

    def shares(self, velocity, gradient):
        """Mean squares of the errors at the chosen points, in units of those of the field."""
        squares = ((velocity - self.sample.field[self.rows]).square().mean(),
                   (gradient - self.sample.gradient[self.rows]).square().mean())
        return [square / mean for square, mean in zip(squares, self.sample.mean_square)]

    def average(self, kernel):
        """Velocity and gradient by an average with a kernel; differentiable in its table, if it has one."""
        particles, tabulated = self.sample.particles, isinstance(kernel, HermiteKernel)
        volumes = particles.volumes_by_table(kernel) if tabulated else particles.volumes(kernel)
        parts = [particles.on_grid(kernel, volumes, rows) for rows in self.rows.split(TOGETHER)]
        return [torch.cat(part) for part in zip(*parts)]

    def best_kernel(self, aim, steps):
        """The table that is best for an aim, by L-BFGS from the cubic spline."""
        q = torch.linspace(0, 1, KNOTS)
        start = CubicSpline(1.0).value(q).clamp_min(1e-3)
        logarithms = start[:-1].log().requires_grad_()
        optimizer = torch.optim.LBFGS([logarithms], max_iter=steps, line_search_fn="strong_wolfe")

        def closure():
            optimizer.zero_grad()
            loss = sum(weight * share for weight, share in zip(aim, self.shares(*self.average(self.table(logarithms)))))
            loss.backward()
            return loss

        optimizer.step(closure)
        with torch.no_grad():
            return self.table(logarithms)

    def table(self, logarithms):
        """A kernel through exp(logarithms), and 0 at the support; its slopes are central differences."""
        values = torch.cat([logarithms.exp(), logarithms.new_zeros(1)])
        slopes = torch.cat([values.new_zeros(1), (values[2:] - values[:-2]) * (KNOTS - 1) / 2, values.new_zeros(1)])
        return HermiteKernel(self.support, values, slopes)

    def errors(self, steps):
        """Errors of velocity and gradient, by what they are of."""
        points = grid_points(self.sample.decomposition, self.sample.decomposition.planes)[self.rows]
        found = {"cubic spline": self.average(CubicSpline(self.support)),
                 "Wendland C2": self.average(WendlandC2(self.support))}
        for name, aim in AIMS.items():
            kernel = self.best_kernel(aim, steps)
            with torch.no_grad():
                found[f"best for {name}"] = self.average(kernel)
        for name, degree in DEGREES.items():
            found[f"moving least squares, {name}"] = fitted(
                points, self.position, self.velocity, self.support, degree)
        return {name: [float(share) ** 0.5 for share in self.shares(*fields)] for name, fields in found.items()}


def fitted(points, position, velocity, support, degree):
    """Values (k, 3) and gradients (k, 3, 3) [component, direction] at points of the polynomials of a degree, 1 or 2,
    that fit the velocities (n, 3) of the particles within the support best, with Wendland's weights."""
    neighbors, weights = NeighborList(PeriodicBox(BOX_LENGTH), support, 0.0), WendlandC2(support)
    neighbors.build(points, position, exclude_self=False)
    values = torch.from_numpy(fitted_by(
        library(), Box(BOX_LENGTH, True), degree, kernel_numbers(support, weights.pieces.numpy()),
        BOX_LENGTH**3 / len(position), LEAST_WEIGHT, neighbors.offsets.numpy(), neighbors.senders.numpy(),
        points.numpy(), position.numpy(), velocity.numpy()))
    return values[:, 0], values[:, 1:].transpose(1, 2)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+")
    parser.add_argument("--neighbors", type=float, default=60.0)
    parser.add_argument("--steps", type=int, default=60)
    options = parser.parse_args()
    for run in options.runs:
        for name, (velocity, gradient) in Field(run, options.neighbors).errors(options.steps).items():
            print(f"{run}, {options.neighbors:g} neighbours, {name}: velocity {velocity:.4f}, gradient {gradient:.4f}")


if __name__ == "__main__":
    main()
