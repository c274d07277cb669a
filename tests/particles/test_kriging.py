"""Derivatives that neighbours tell of known fields, whose own are known by plain transforms."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from eddies.particles.flow_units import FlowUnits
from eddies.particles.moments import ENTRIES
from tests.particles.configurations import LENGTH, SCALES, by_id, distributed, dynamics_of, model
from tests.validation.filtered_fields import WAVE, at, random_velocity

SIDE = 14
SPACING = LENGTH / SIDE
# 60 neighbours, a filter of two spacings: as scenes have them.
FLOW = FlowUnits(replace(SCALES, spacing=SPACING, filter_width=2 * SPACING),
                 SPACING * (60 / (4 / 3 * np.pi)) ** (1 / 3), 60.0)
POSITION = LENGTH * np.random.default_rng(1).random((SIDE**3, 3))


def kriging(comm, field, dtype=torch.float64):
    """What neighbours tell, and the particles of this rank, which have the field as their velocity."""
    slab, particles = distributed(comm, torch.from_numpy(POSITION), torch.from_numpy(field),
                                  torch.ones(len(POSITION), dtype=torch.float64))
    dynamics = dynamics_of(slab, model({"filtered-equations": {}}, FLOW), dtype=dtype)
    return dynamics.context(particles).kriging, particles


def relative(found, exact):
    return float(np.linalg.norm(found - exact) / np.linalg.norm(exact))


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
def test_derivatives_of_a_field_of_few_modes(comm, dtype):
    """Waves of seven spacings and more."""
    modes = random_velocity(2)
    told, particles = kriging(comm, at(modes, POSITION), dtype)
    untold, first, second = (by_id(comm, particles, part.double(), len(POSITION)).numpy()
                             for part in told.derivatives(particles.velocity))
    exact = np.stack([at(1j * k * modes, POSITION) for k in WAVE], -1)
    assert relative(first, exact) < 0.06
    exact = np.stack([at(-WAVE[j] * WAVE[k] * modes, POSITION) for j, k in ENTRIES], -1)
    assert relative(second[:, :, [j for j, _ in ENTRIES], [k for _, k in ENTRIES]], exact) < 0.16
    assert np.array_equal(second, second.transpose(0, 1, 3, 2))
    assert relative(untold + at(modes, POSITION), at(modes, POSITION)) < 0.03


@pytest.mark.mpi(1)
def test_a_constant_has_no_derivatives_and_is_told_by_any_neighbour(comm):
    told, particles = kriging(comm, np.ones_like(POSITION))
    untold, first, second = told.derivatives(particles.velocity)
    assert first.abs().max() * SPACING < 1e-10 and second.abs().max() * SPACING**2 < 1e-9
    assert untold.abs().max() < 1e-10


@pytest.mark.mpi(1)
def test_gradient_and_laplacian_are_those_of_all_derivatives(comm):
    told, particles = kriging(comm, at(random_velocity(2), POSITION))
    field = particles.velocity[:, 0]
    _, first, second = told.derivatives(particles.velocity)
    assert torch.allclose(told.gradient(field), first[:, 0], rtol=1e-12)
    laplacian = second[:, 0].diagonal(dim1=1, dim2=2).sum(1)
    assert torch.allclose(told.laplacian(field), laplacian, rtol=1e-9, atol=1e-9 * float(laplacian.abs().max()))
    # No field of this size has a larger Laplacian: a spike, nor the one of all signs that a particle's weights have.
    assert (told.laplacian(torch.sign(field)).abs() <= told.laplacian_bound * (1 + 1e-12)).all()
    spike = torch.zeros_like(field)
    spike[5] = 1
    assert 0.2 * told.laplacian_bound[5] < -told.laplacian(spike)[5] < 0.6 * told.laplacian_bound[5]


@pytest.mark.mpi(1, 2)
def test_what_it_tells_is_linear_and_can_be_differentiated_by_the_field(comm):
    told, particles = kriging(comm, at(random_velocity(2), POSITION))
    field = particles.velocity[:, 0].clone().requires_grad_()
    direction = particles.velocity[:, 1]
    other = torch.cos(particles.position[:, 0])
    product = (told.laplacian(field) * other).sum() + (told.gradient(field)[:, 2] * other).sum()
    (slope,) = torch.autograd.grad(product, field)
    moved = ((told.laplacian(field + direction) * other).sum() + (told.gradient(field + direction)[:, 2] * other).sum()
             - product).detach()
    both = comm.allreduce(np.array([float(moved), float((slope * direction).sum())]))
    assert both[0] == pytest.approx(both[1], rel=1e-9)
