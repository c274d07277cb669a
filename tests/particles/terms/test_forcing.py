"""The force against that of the direct simulation, filtered, and against waves whose force is known."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from eddies.flow.forcing import LinearForcing
from eddies.flow.initial_fields import random_velocity
from eddies.flow.tracers import FilteredField, TracerParticles, release
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.flow_units import FlowUnits
from eddies.particles.particle_set import ParticleSet
from eddies.scene.terms import TermError
from eddies.scene.values import SceneError
from eddies.spectral.spectral_grid import SpectralGrid
from tests.particles.configurations import (CUTOFF, LENGTH, NEIGHBORS, SCALES, alone, along, distributed, dynamics_of,
                                            model, positions, state)


def force_on(slab, particles, rate, wavenumber=2.0, tolerance=None):
    terms = model(injection=dict(injection_rate=rate, wavenumber=wavenumber))
    return dynamics_of(slab, terms, tolerance=tolerance).rates(particles).acceleration


def waves(position, *amplitudes):
    """The sum of solenoidal waves of |k| = 1 and 3, and of a compressive one of |k| = 1; and the first of them."""
    x, y, z = position.T
    zero = torch.zeros_like(x)
    parts = [torch.stack(part, 1) for part in ((torch.sin(z), torch.cos(x), zero),
                                               (torch.sin(3 * y), zero, torch.sin(3 * x)), (torch.sin(x), zero, zero))]
    return sum(amplitude * part for amplitude, part in zip(amplitudes, parts)), parts[0]


def lattice(side):
    axis = torch.arange(side, dtype=torch.float64) * (LENGTH / side)
    return torch.cartesian_prod(axis, axis, axis)


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("wavenumber", [2.0, 3.1])
def test_the_force_is_that_of_the_direct_simulation_filtered(comm, wavenumber):
    side, rate = 10, 0.37
    spacing = LENGTH / side
    grid = SpectralGrid(SlabDecomposition(comm, LENGTH, 24))
    velocity, force = random_velocity(grid, 3, 1.0, 2.0), np.zeros((3, *grid.spectral_shape), complex)
    LinearForcing(grid, rate, wavenumber).add(velocity, force)
    field = FilteredField(grid, 2 * spacing, "quintic")
    columns = TracerParticles(field, release(grid.decomposition, 5, side, "random"), velocity).columns
    exact = torch.from_numpy(field.spline.at(field.velocity_coefficients(force), columns["position"]))

    flow = FlowUnits(replace(SCALES, filter_width=2 * spacing, spacing=spacing), CUTOFF, NEIGHBORS)
    terms = model({"injection": dict(injection_rate=rate, wavenumber=wavenumber)}, flow)
    dynamics = dynamics_of(SlabDecomposition(comm, LENGTH, 24), terms)
    found = dynamics.rates(ParticleSet.from_numpy(columns)).acceleration
    error, product, square = global_sum(comm, np.array([
        float((found - exact).square().sum()), float((found * exact).sum()), float(exact.square().sum())]))
    # What the particles tell of the modes; a power of the filtered velocity would be 20 to 60 % above.
    assert error < 0.03**2 * square
    assert product / square == pytest.approx(1, abs=0.02)


@pytest.mark.mpi(1, 3)
@pytest.mark.parametrize("others", [(1.0, 0.0), (0.0, 0.1)], ids=["small scales", "compressive motion"])
def test_the_large_solenoidal_scales_alone_are_forced(comm, others):
    """The power goes into the velocity before the filter, which passes G^2 = exp(-d^2/12) of its energy at k = 1."""
    position = lattice(12)
    velocity, large = waves(position, 0.1, *others)
    slab, particles = distributed(comm, position, velocity, planes=24)
    # The mean square of the wave is 1.
    expected = math.exp(-SCALES.filter_width**2 / 12) / 0.1 * large[particles.id]
    # Regularisation takes less than a thousandth of such waves, splines less.
    assert (force_on(slab, particles, 1.0, tolerance=1e-5) - expected).abs().max() < 0.005 * expected.abs().max()


@pytest.mark.mpi(1, 2)
def test_momentum_is_kept(comm):
    slab, particles = distributed(comm, *state()[:2])
    force = force_on(slab, particles, 0.37)
    total = global_sum(comm, np.array([*force.sum(0).tolist(), float(force.abs().sum())]))
    assert np.abs(total[:3]).max() < 1e-12 * total[3] and total[3] > 0


@pytest.mark.mpi(1)
def test_gradient_against_central_differences(comm):
    position = positions(count=100)
    slab, particles = distributed(comm, position, waves(position, 1.0, 0.3)[0])
    random = torch.Generator().manual_seed(comm.rank)
    direction = [torch.randn(particles.position.shape, dtype=torch.float64, generator=random) for _ in range(2)]
    inputs = [column.clone().requires_grad_() for column in (particles.position, particles.velocity)]

    def share(position, velocity):
        force = force_on(slab, type(particles)(particles.id, position, velocity), 0.3, tolerance=1e-9)
        return (force**2).sum() + force[:, 0].sum()

    gradients = torch.autograd.grad(share(*inputs), inputs)
    expected = float(sum((gradient * change).sum() for gradient, change in zip(gradients, direction)))
    found = float(along(share, inputs, direction, 1e-5))
    assert float(global_sum(comm, found)) == pytest.approx(float(global_sum(comm, expected)), rel=1e-4)


@pytest.mark.mpi(1)
def test_what_cannot_be_forced_is_refused(comm):
    with pytest.raises(SceneError, match="injection_rate"):
        model(injection=dict(injection_rate=-1.0))
    with pytest.raises(SceneError, match="wavenumber"):
        model(injection=dict(injection_rate=1.0, wavenumber=1.0))
    slab, particles = alone(torch.rand(4, 3, dtype=torch.float64), torch.zeros(4, 3, dtype=torch.float64))
    with pytest.raises(TermError, match="no energy"):
        force_on(slab, particles, 1.0)
    assert torch.equal(force_on(slab, particles, 0.0), particles.velocity)
