"""Compiled averages over particles against those of torch, for each instruction set that this processor runs."""

import numpy as np
import pytest
import torch

from eddies.flow.tracers import release
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.exchanges import with_ghosts
from eddies.particles.particle_field import ParticleField, reconstruct_with_gradient
from eddies.particles.smoothing_kernels import CubicSpline, KernelNetwork, WendlandC2

LENGTH = 2 * np.pi
KERNELS = {"cubic spline": CubicSpline, "wendland": WendlandC2,
           "tabulated": lambda support: KernelNetwork(support, (5,)).double().table()}


@pytest.mark.parametrize("kind", KERNELS)
def test_pieces_are_the_kernel(kind):
    with torch.no_grad():
        kernel = KERNELS[kind](0.7)
    coefficients = kernel.pieces.double()
    distance = torch.linspace(0, 0.7, 1001, dtype=torch.float64)[:-1]
    place = distance / 0.7 * len(coefficients)
    u = 1 - (place - place.floor())
    found = sum(c * u**power for power, c in enumerate(coefficients[place.long()].T))
    assert torch.allclose(found, kernel.value(distance), rtol=1e-12, atol=1e-14)


def averages(field, kernel):
    """Averages by the compiled library: volumes, and velocity and gradient at grid points and at particles."""
    return [field.volumes(kernel), field.averaged_on_grid(kernel), *field.averaged(kernel, field.points),
            *field.averaged(kernel, field.owned)]


def averages_by_torch(field, kernel):
    at_points, at_particles = (field._neighbors_of(points).pairs(points, field._position, dtype=field.dtype)
                               for points in (field.points, field.owned))
    volume = with_ghosts(field.halo, 1 / at_particles.sum(kernel.value(at_particles.distance)[None])[0])
    on_grid, on_particles = (reconstruct_with_gradient(kernel, pairs, volume, field._velocity)
                             for pairs in (at_points, at_particles))
    velocities = [velocity + field._mean for velocity, _ in (on_grid, on_particles)]
    return [volume, velocities[0], velocities[0], on_grid[1], velocities[1], on_particles[1]]


@pytest.mark.mpi(1, 3)
@pytest.mark.parametrize("kind, dtype, rounding, neighbors", [
    ("cubic spline", torch.float64, 1e-11, 60), ("wendland", torch.float32, 2e-4, 60),
    ("tabulated", torch.float64, 1e-11, 60), ("tabulated", torch.float32, 2e-4, 60),
    ("wendland", torch.float64, 1e-11, 3)])
def test_averages_are_those_of_torch(comm, library, kind, dtype, rounding, neighbors):
    """Also with so few neighbours that some points have none, and gradients are quotients of small numbers."""
    slab = SlabDecomposition(comm, LENGTH, 15)
    position = torch.from_numpy(release(slab, 3, 12**3, "random")["position"])
    support = LENGTH / 12 * (neighbors / (4 / 3 * np.pi)) ** (1 / 3)
    field = ParticleField(slab, 1.2 * support, position, torch.sin(2 * position), dtype)
    with torch.no_grad():
        kernel = KERNELS[kind](support)
    for one, other in zip(averages(field, kernel), averages_by_torch(field, kernel), strict=True):
        assert one.shape == other.shape
        assert (one - other).abs().max() <= rounding * other.abs().max() > 0
