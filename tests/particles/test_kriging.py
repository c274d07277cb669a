"""Kriging estimates of the derivatives of known fields."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from eddies.particles.flow_units import FlowUnits
from eddies.particles.context import ENTRIES
from tests.particles.configurations import LENGTH, SCALES, by_id, distributed, dynamics_of, model, relative
from tests.validation.filtered_fields import WAVE, at, random_velocity

SIDE = 14
SPACING = LENGTH / SIDE
# As in scenes: 60 neighbours, and a filter of two spacings.
FLOW = FlowUnits(replace(SCALES, spacing=SPACING, filter_width=2 * SPACING),
                 SPACING * (60 / (4 / 3 * np.pi)) ** (1 / 3), 60.0)
POSITION = LENGTH * np.random.default_rng(1).random((SIDE**3, 3))


def kriging(comm, field, dtype=torch.float64):
    """Kriging, and the particles of this rank, whose velocity is the field."""
    slab, particles = distributed(comm, torch.from_numpy(POSITION), torch.from_numpy(field),
                                  torch.ones(len(POSITION), dtype=torch.float64))
    dynamics = dynamics_of(slab, model({"filtered-equations": {}}, FLOW), dtype=dtype)
    return dynamics.context(particles).kriging, particles


@pytest.mark.mpi(2)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
def test_derivatives_of_a_field_of_few_modes(comm, dtype):
    """Waves of seven spacings and more."""
    modes = random_velocity(2)
    estimates, particles = kriging(comm, at(modes, POSITION), dtype)
    residual, first, second = (by_id(comm, particles, part.double(), len(POSITION)).numpy()
                               for part in estimates.derivatives(particles.velocity))
    assert relative(first, np.stack([at(1j * k * modes, POSITION) for k in WAVE], -1)) < 0.06
    exact = np.stack([at(-WAVE[j] * WAVE[k] * modes, POSITION) for j, k in ENTRIES], -1)
    assert relative(second[:, :, [j for j, _ in ENTRIES], [k for _, k in ENTRIES]], exact) < 0.16
    assert np.array_equal(second, second.transpose(0, 1, 3, 2))
    assert np.linalg.norm(residual) < 0.03 * np.linalg.norm(at(modes, POSITION))


@pytest.mark.mpi(1)
def test_gradient_and_laplacian_are_those_of_all_derivatives(comm):
    estimates, particles = kriging(comm, at(random_velocity(2), POSITION))
    field = particles.velocity[:, 0]
    _, first, second = estimates.derivatives(particles.velocity)
    assert torch.allclose(estimates.gradient(field), first[:, 0], rtol=1e-12)
    laplacian = second[:, 0].diagonal(dim1=1, dim2=2).sum(1)
    assert torch.allclose(estimates.laplacian(field), laplacian, rtol=1e-9, atol=1e-9 * float(laplacian.abs().max()))
    # The bound holds for any field of this magnitude, and a spike has a Laplacian of its order.
    assert (estimates.laplacian(torch.sign(field)).abs() <= estimates.laplacian_bound * (1 + 1e-12)).all()
    spike = torch.zeros_like(field)
    spike[5] = 1
    assert 0.2 * estimates.laplacian_bound[5] < -estimates.laplacian(spike)[5] < 0.6 * estimates.laplacian_bound[5]


@pytest.mark.mpi(2)
def test_estimates_are_linear_and_differentiable_in_the_field(comm):
    estimates, particles = kriging(comm, at(random_velocity(2), POSITION))
    field, direction = particles.velocity[:, 0].clone().requires_grad_(), particles.velocity[:, 1]
    weight = torch.cos(particles.position[:, 0])

    def product(field):
        return (estimates.laplacian(field) * weight).sum() + (estimates.gradient(field)[:, 2] * weight).sum()

    (slope,) = torch.autograd.grad(product(field), field)
    with torch.no_grad():
        change = product(field + direction) - product(field)
    both = comm.allreduce(np.array([float(change), float((slope * direction).sum())]))
    assert both[0] == pytest.approx(both[1], rel=1e-9)
