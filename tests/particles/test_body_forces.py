import numpy as np
import pytest
import torch
from clouds import LENGTH, distributed, state

from eddies.parallel.reduction import global_sum
from eddies.particles.body_forces import LinearForcing


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("kind", ["even", "void"])
def test_injection_is_as_prescribed_and_momentum_is_kept(comm, kind):
    _, particles = distributed(comm, *state(kind=kind))
    force = LinearForcing(0.37, 2.0, comm)(particles.position, particles.velocity)
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
    _, particles = distributed(comm, position, 0.1 * large + small, torch.ones(512, dtype=torch.float64))
    force = LinearForcing(1.0, 2.0, comm)(particles.position, particles.velocity)
    # The mean of (large + small) . A large is A, at a tenth of the amplitude.
    assert torch.allclose(force, 10.0 * large[particles.id], atol=1e-12)


@pytest.mark.mpi(1)
def test_compressive_motion_is_not_forced(comm):
    axis = torch.arange(8, dtype=torch.float64) * (LENGTH / 8)
    position = torch.cartesian_prod(axis, axis, axis)
    solenoidal = torch.stack([torch.sin(position[:, 1]), torch.zeros(512), torch.zeros(512)], 1)
    compressive = torch.stack([torch.sin(position[:, 0]), torch.zeros(512), torch.zeros(512)], 1)
    force = LinearForcing(0.5, 2.0, comm)(position, solenoidal + compressive)
    assert torch.allclose(force, solenoidal, atol=1e-12)


@pytest.mark.mpi(1)
def test_what_cannot_be_forced_is_refused(comm):
    with pytest.raises(ValueError, match="must not be negative"):
        LinearForcing(-1.0, 2.0, comm)
    with pytest.raises(ValueError, match="must exceed 1"):
        LinearForcing(1.0, 1.0, comm)
    position = torch.rand(4, 3, dtype=torch.float64)
    with pytest.raises(ValueError, match="no energy"):
        LinearForcing(1.0, 2.0, comm)(position, torch.ones(4, 3, dtype=torch.float64) * 0)
    with pytest.raises(RuntimeError, match="cannot be differentiated"):
        LinearForcing(1.0, 2.0, comm)(position.requires_grad_(), position)
