import numpy as np
import pytest
import torch

from eddies.parallel.halo import HaloExchange
from eddies.parallel.reduction import global_sum
from eddies.particles.exchanges import with_ghosts
from tests.particles.configurations import distributed, state


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("positions", [False, True])
def test_backward_is_the_adjoint_of_forward(comm, positions):
    slab, particles = distributed(comm, *state(kind="uneven"))
    halo = HaloExchange(slab, particles.position.numpy(), 1.7)
    random = torch.manual_seed(comm.rank)
    position = particles.position.clone().requires_grad_()
    rows = with_ghosts(halo, position, positions)
    weight = torch.randn(rows.shape, dtype=torch.float64, generator=random)
    (gradient,) = torch.autograd.grad((weight * rows).sum(), position)
    moved = torch.randn(position.shape, dtype=torch.float64, generator=random)
    with torch.no_grad():
        forwards = (weight * (with_ghosts(halo, position + moved, positions) - rows)).sum().item()
    both = global_sum(comm, np.array([forwards, (gradient * moved).sum().item()]))
    assert both[0] == pytest.approx(both[1], rel=1e-12, abs=1e-12)
