import numpy as np
import pytest
import torch
from clouds import CUTOFF, LENGTH, SCALES, distributed, model, state

from eddies.parallel.reduction import global_sum
from eddies.particles.dense_network import DenseNetwork
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.feature_range import FeatureRange


def set_up(comm, speed=1.0):
    position, velocity, density = state()
    slab, particles = distributed(comm, position, speed * velocity, density)
    force = model()
    dynamics = ParticleDynamics(slab, LENGTH, [force], 0.2)
    return force.network, lambda: dynamics.rates(particles)["velocity"].detach()


@pytest.mark.mpi(1, 2)
def test_pairs_of_the_training_data_lie_inside_the_range_and_faster_ones_outside(comm):
    network, evaluate = set_up(comm)
    seen = FeatureRange.of(comm, network, evaluate)
    # Inputs: rho'_i, rho'_j, |x|, |v|, x.v; the first two are those of the same pairs, seen from both ends.
    assert seen.low[0] == pytest.approx(seen.low[1]) and seen.high[0] == pytest.approx(seen.high[1])
    assert 0 < seen.low[2] < 0.3 and 0.95 * CUTOFF < SCALES.length * seen.high[2] <= CUTOFF
    rates, share = seen.share_outside(comm, network, evaluate)
    assert share == 0 and torch.equal(rates, evaluate())
    faster, evaluate = set_up(comm, speed=3.0)
    assert 0.02 < seen.share_outside(comm, faster, evaluate)[1] < 0.9


@pytest.mark.mpi(1, 2)
def test_the_share_counts_pairs_of_all_ranks_once(comm):
    """Rank 0 gives four pairs and rank 1 twice as many; of each one is too large in both inputs, one not a number."""
    network = DenseNetwork(2, (3,), 1, seed=1).double()
    values = torch.zeros(2, 4 * (comm.rank + 1), dtype=torch.float64)
    values[:, 0], values[1, 1] = 7.0, torch.nan
    unit = FeatureRange(np.array([-1.0, -1.0]), np.array([1.0, 1.0]))
    pairs = int(global_sum(comm, values.shape[1]))
    assert unit.share_outside(comm, network, lambda: network(values))[1] == pytest.approx(2 * comm.size / pairs)
    assert unit.share_outside(comm, network, lambda: network(values[:, :0]))[1] == 0


@pytest.mark.mpi(1)
def test_afterwards_the_network_is_watched_no_more(comm):
    network, evaluate = set_up(comm)
    seen = FeatureRange.of(comm, network, evaluate)
    with pytest.raises(ZeroDivisionError):
        seen.share_outside(comm, network, lambda: 1 / 0)
    assert not network._forward_pre_hooks
