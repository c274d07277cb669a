import numpy as np
import pytest
import torch
from mpi4py import MPI

from eddies.particles import context
from eddies.particles.feature_range import FeatureRange, pair_features
from tests.particles.configurations import CUTOFF, SCALES, distributed, dynamics_of, model, state


def blocks(comm, speed=1.0):
    position, velocity, density = state()
    slab, particles = distributed(comm, position, speed * velocity, density)
    return pair_features(dynamics_of(slab, model(pairs={})), particles)


@pytest.mark.mpi(1, 3)
def test_pairs_of_the_training_lie_inside_the_range_and_faster_ones_outside(comm, monkeypatch):
    """Range and share are the same on any number of ranks."""
    monkeypatch.setitem(context.PAIR_VALUES_TOGETHER, "cpu", 300)
    ranges = [FeatureRange.of(group, blocks(group)) for group in (comm, MPI.COMM_SELF)]
    seen = ranges[0]
    # rho'_i and rho'_j; then |x|, |v|, x.v.
    assert seen.low[0] == seen.low[1] < 0 < seen.high[0] == seen.high[1]
    assert 0 < seen.low[2] < 0.3 and 0.95 * CUTOFF < SCALES.filter_width * seen.high[2] <= CUTOFF
    for bound in ("low", "high"):
        assert np.allclose(*(getattr(each, bound) for each in ranges), rtol=1e-12, atol=1e-12)
    assert seen.share_outside(comm, blocks(comm)) == 0
    shares = [ranges[1].share_outside(group, blocks(group, speed=3.0)) for group in (comm, MPI.COMM_SELF)]
    assert 0.02 < shares[0] == shares[1] < 0.9


@pytest.mark.mpi(1, 2)
def test_pairs_of_all_ranks_count_once(comm):
    """Rank 0 has four pairs and rank 1 eight; on each one pair is too large in both features and one is NaN."""
    values = torch.zeros(2, 4 * (comm.rank + 1), dtype=torch.float64)
    values[:, 0], values[1, 1] = 7.0, torch.nan
    unit = FeatureRange(np.array([-1.0, -1.0]), np.array([1.0, 1.0]))
    assert unit.share_outside(comm, [values, values[:, :0]]) == {1: 2 / 4, 2: 4 / 12}[comm.size]
    assert unit.share_outside(comm, [values[:, :0]]) == 0
    values = torch.tensor([[1.0, 2.0], [-3.0, -1.0]], dtype=torch.float64)
    last = comm.rank == comm.size - 1  # the others have no pairs
    seen = FeatureRange.of(comm, [values if last else values[:, :0], values[:, :0]])
    assert seen.low.tolist() == [1, -3] and seen.high.tolist() == [2, -1]
