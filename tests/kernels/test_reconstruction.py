"""Compiled averages over particles against torch."""

import numpy as np
import pytest
import torch

from eddies.flow.tracers import release
from eddies.kernels.reconstruction import GridPlanes, sums_on_grid, told_kernel
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.particle_field import ParticleField
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
    """Every average of a field that has no gradient."""
    with torch.no_grad():
        volume = field.volumes(kernel)
        return [volume, field.velocity_on_whole_grid(kernel, volume), *field.averaged(kernel, volume, field.points),
                *field.at_particles(kernel, volume), *field.fitted(kernel, 1, (LENGTH / 12) ** 3, field.points)]


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("kind, neighbors, dtype, rounding", [
    ("cubic spline", 60, torch.float64, 1e-11), ("tabulated", 60, torch.float32, 2e-4),
    ("wendland", 3, torch.float64, 1e-11)])
def test_averages(comm, library, close, monkeypatch, kind, neighbors, dtype, rounding):
    """Also with so few neighbours that some points have none, and gradients are quotients of small numbers."""
    slab = SlabDecomposition(comm, LENGTH, 15)
    position = torch.from_numpy(release(slab, 3, 12, "random")["position"])
    support = LENGTH / 12 * (neighbors / (4 / 3 * np.pi)) ** (1 / 3)
    field = ParticleField(slab, 1.2 * support, position, torch.sin(2 * position), dtype)
    with torch.no_grad():
        kernel = KERNELS[kind](support)
    monkeypatch.setattr("eddies.particles.pairs.library", lambda: library)
    monkeypatch.setattr("eddies.particles.particle_field.library", lambda: library)
    found = averages(field, kernel)
    monkeypatch.setattr("eddies.particles.particle_field.kernels_serve", lambda device: False)
    for one, other in zip(found, averages(field, kernel), strict=True):
        close(one.numpy(), other.numpy(), rounding)


def test_wrong_columns_are_refused(library):
    with pytest.raises(ValueError, match="needed"):
        sums_on_grid(library, GridPlanes(8, 0.1, 0, 8, True), told_kernel(0.2, np.ones((1, 4))), np.zeros((5, 3)),
                     np.zeros((5, 3)))
