import numpy as np
import pytest
import torch
from mpi4py import MPI

from eddies.particles import context
from eddies.particles.dense_network import DenseNetwork
from eddies.particles.feature_range import FeatureRange, pair_features
from tests.particles.configurations import CUTOFF, SCALES, by_torch, distributed, dynamics_of, model, state

CHOICES = {"corrected": dict(), "antisymmetric": dict(basis="paper", symmetry="antisymmetric")}
every_model = pytest.mark.parametrize("choices", CHOICES.values(), ids=CHOICES)


def set_up(comm, choices, speed=1.0):
    position, velocity, density = state()
    slab, particles = distributed(comm, position, speed * velocity, density)
    return dynamics_of(slab, model(pairs=choices)), particles


def blocks(comm, choices, speed=1.0):
    return pair_features(*set_up(comm, choices, speed))


@every_model
@pytest.mark.mpi(1, 2, 3)
def test_pairs_of_the_training_data_lie_inside_the_range_and_faster_ones_outside(comm, choices, monkeypatch):
    monkeypatch.setitem(context.PAIR_VALUES_TOGETHER, "cpu", 300)
    seen = FeatureRange.of(comm, blocks(comm, choices))
    # rho'_i, rho'_j, |x|, |v|, x.v, or rho'_i + rho'_j and (rho'_i - rho'_j)^2 at first
    if choices:
        assert seen.low[0] < 0 < seen.high[0] and 0 <= seen.low[1] < 0.1 < seen.high[1]
    else:  # the same pairs, seen from both ends
        assert seen.low[0] == seen.low[1] < 0 < seen.high[0] == seen.high[1]
    assert 0 < seen.low[2] < 0.3 and 0.95 * CUTOFF < SCALES.filter_width * seen.high[2] <= CUTOFF
    assert seen.share_outside(comm, blocks(comm, choices)) == 0
    assert 0.02 < seen.share_outside(comm, blocks(comm, choices, speed=3.0)) < 0.9


@every_model
@pytest.mark.mpi(2, 3)
def test_range_and_share_are_the_same_on_any_number_of_ranks(comm, choices):
    one, several = ((FeatureRange.of(group, blocks(group, choices)), group) for group in (MPI.COMM_SELF, comm))
    for bound in ("low", "high"):
        # Nearest images round otherwise beside a ghost.
        assert np.allclose(getattr(several[0], bound), getattr(one[0], bound), rtol=1e-12, atol=1e-12)
    shares = [one[0].share_outside(group, blocks(group, choices, speed=3.0)) for _, group in (one, several)]
    assert shares[0] == shares[1] > 0.02


@pytest.mark.mpi(1)
def test_features_are_what_the_network_is_given(comm, monkeypatch):
    dynamics, particles = set_up(comm, {})
    by_torch(monkeypatch)
    given, plain = [], DenseNetwork.forward

    def noting(network, features):
        given.append(features)
        return plain(network, features)

    monkeypatch.setattr(DenseNetwork, "forward", noting)
    with torch.no_grad():
        dynamics.rates(particles)
    shown = list(pair_features(dynamics, particles))
    assert len(given) == len(shown) and all(map(torch.equal, given, shown))


@pytest.mark.mpi(1)
def test_features_of_two_networks_stand_one_after_the_other(comm):
    slab, particles = distributed(comm, *state())
    both = model(pairs=dict(inputs=("distance", "approach")), density_flux={})
    (found,) = pair_features(dynamics_of(slab, both), particles)
    parts = [next(iter(pair_features(dynamics_of(slab, model(terms)), particles)))
             for terms in ({"pairs": dict(inputs=("distance", "approach"))}, {"density-flux": {}})]
    assert torch.equal(found, torch.cat(parts)) and len(found) == 2 + 5


@pytest.mark.mpi(1)
def test_a_network_that_is_told_no_density_needs_none(comm):
    slab, particles = distributed(comm, *state()[:2])
    (found,) = pair_features(dynamics_of(slab, model(pairs=dict(inputs=("distance", "speed", "approach")))), particles)
    assert len(found) == 3


@pytest.mark.mpi(1, 2)
def test_the_share_counts_pairs_of_all_ranks_once(comm):
    """Rank 0 gives four pairs and rank 1 twice as many; of each one is too large in both inputs, one not a number."""
    values = torch.zeros(2, 4 * (comm.rank + 1), dtype=torch.float64)
    values[:, 0], values[1, 1] = 7.0, torch.nan
    unit = FeatureRange(np.array([-1.0, -1.0]), np.array([1.0, 1.0]))
    assert unit.share_outside(comm, [values, values[:, :0]]) == {1: 2 / 4, 2: 4 / 12}[comm.size]
    assert unit.share_outside(comm, [values[:, :0]]) == 0


@pytest.mark.mpi(1, 2)
def test_a_rank_without_pairs_widens_nothing(comm):
    values = torch.tensor([[1.0, 2.0], [-3.0, -1.0]], dtype=torch.float64)
    last = comm.rank == comm.size - 1
    seen = FeatureRange.of(comm, [values if last else values[:, :0], values[:, :0]])
    assert seen.low.tolist() == [1, -3] and seen.high.tolist() == [2, -1]
