import numpy as np
import pytest
import torch

from eddies.parallel.reduction import global_sum
from eddies.particles.terms.term import TermError
from eddies.scene.values import SceneError
from tests.particles.configurations import LENGTH, alone, along, distributed, dynamics_of, model, state


def force_on(slab, particles, rate, wavenumber=2.0):
    terms = model(forcing=dict(injection_rate=rate, wavenumber=wavenumber))
    return dynamics_of(slab, terms).rates(particles).acceleration


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("kind", ["even", "void"])
def test_injection_is_as_prescribed_and_momentum_is_kept(comm, kind):
    slab, particles = distributed(comm, *state(kind=kind)[:2])
    force = force_on(slab, particles, 0.37)
    work = (force * particles.velocity).sum().item()
    total = global_sum(comm, np.array([work, *force.sum(0).tolist()]))
    assert total[0] / 200 == pytest.approx(0.37, rel=1e-12)
    assert np.abs(total[1:]).max() < 1e-11


@pytest.mark.mpi(1, 3)
def test_small_scales_are_not_forced(comm):
    """Velocity of wavenumber 3 on a lattice, with a little of wavenumber 1: only the latter is forced."""
    axis = torch.arange(8, dtype=torch.float64) * (LENGTH / 8)
    position = torch.cartesian_prod(axis, axis, axis)
    large = torch.stack([torch.sin(position[:, 2]), torch.cos(position[:, 0]), torch.zeros(512)], 1)
    small = torch.stack([torch.sin(3 * position[:, 1]), torch.zeros(512), torch.sin(3 * position[:, 0])], 1)
    slab, particles = distributed(comm, position, 0.1 * large + small)
    # The mean of (large + small) . A large is A, at a tenth of the amplitude.
    assert torch.allclose(force_on(slab, particles, 1.0), 10.0 * large[particles.id], atol=1e-12)


@pytest.mark.mpi(1)
def test_compressive_motion_is_not_forced(comm):
    axis = torch.arange(8, dtype=torch.float64) * (LENGTH / 8)
    position = torch.cartesian_prod(axis, axis, axis)
    solenoidal = torch.stack([torch.sin(position[:, 1]), torch.zeros(512), torch.zeros(512)], 1)
    compressive = torch.stack([torch.sin(position[:, 0]), torch.zeros(512), torch.zeros(512)], 1)
    slab, particles = alone(position, solenoidal + compressive)
    assert torch.allclose(force_on(slab, particles, 0.5), solenoidal[particles.id], atol=1e-12)


@pytest.mark.mpi(1, 2)
def test_gradient_against_central_differences(comm):
    slab, particles = distributed(comm, *state(60)[:2])
    random = torch.Generator().manual_seed(comm.rank)
    direction = [torch.randn(particles.position.shape, dtype=torch.float64, generator=random) for _ in range(2)]
    inputs = [column.clone().requires_grad_() for column in (particles.position, particles.velocity)]

    def share(position, velocity):
        force = force_on(slab, type(particles)(particles.id, position, velocity), 0.3)
        return (force**2).sum() + force[:, 0].sum()

    gradients = torch.autograd.grad(share(*inputs), inputs)
    expected = float(sum((gradient * change).sum() for gradient, change in zip(gradients, direction)))
    found = float(along(share, inputs, direction, 1e-5))
    assert float(global_sum(comm, found)) == pytest.approx(float(global_sum(comm, expected)), rel=1e-6)


@pytest.mark.mpi(1)
def test_what_cannot_be_forced_is_refused(comm):
    with pytest.raises(SceneError, match="injection_rate"):
        model(forcing=dict(injection_rate=-1.0))
    with pytest.raises(SceneError, match="wavenumber"):
        model(forcing=dict(injection_rate=1.0, wavenumber=1.0))
    slab, particles = alone(torch.rand(4, 3, dtype=torch.float64), torch.zeros(4, 3, dtype=torch.float64))
    with pytest.raises(TermError, match="no energy"):
        force_on(slab, particles, 1.0)
    assert torch.equal(force_on(slab, particles, 0.0), particles.velocity)
