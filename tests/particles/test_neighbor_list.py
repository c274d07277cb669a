import pytest
import torch

from eddies.particles.neighbor_list import NeighborList
from eddies.particles.periodic_box import PeriodicBox
from tests.particles.configurations import LENGTH, positions


def listed(receivers, senders, cutoff):
    neighbors = NeighborList(PeriodicBox(LENGTH), cutoff, 0.0)
    neighbors.build(receivers, senders, exclude_self=True)
    return neighbors


@pytest.mark.parametrize("receivers, senders", [(0, 0), (0, 5), (5, 0), (1, 1)])
def test_few_or_no_particles(receivers, senders):
    position = positions(count=5)
    neighbors = listed(position[:receivers], position[:senders], 1.0)
    pairs = neighbors.pairs(position[:receivers], position[:senders])
    assert len(pairs.sender) == 0 and pairs.sum(torch.ones(0, 2)).shape == (receivers, 2)
    assert [*neighbors.blocks(10)][-1].stop == receivers


def test_blocks_cover_all_rows_once_with_about_as_many_pairs():
    position = positions("uneven", 300)
    neighbors = listed(position, position, 0.8)
    blocks = list(neighbors.blocks(100))
    assert [row for block in blocks for row in range(block.start, block.stop)] == list(range(300))
    most = int(neighbors.offsets.diff().max())
    sizes = [int(neighbors.offsets[block.stop] - neighbors.offsets[block.start]) for block in blocks]
    assert len(blocks) > 10 and max(sizes) <= 100 + most


def test_displacements_are_differentiable_and_nearest():
    position = positions(count=60).requires_grad_()
    pairs = listed(position, position, 1.5).pairs(position, position)
    assert torch.allclose(pairs.distance, pairs.displacement.norm(dim=1)) and pairs.distance.max() < 1.5
    weight = torch.rand(len(pairs.sender), 3, dtype=torch.float64)
    (gradient,) = torch.autograd.grad((weight * pairs.displacement).sum(), position)
    expected = torch.zeros(60, 3, dtype=torch.float64)
    expected.index_add_(0, pairs.receiver, weight).index_add_(0, pairs.sender, -weight)
    assert torch.allclose(gradient, expected)


@pytest.mark.parametrize("tail", [(), (2, 3)])
def test_segment_sum_and_its_gradient(tail):
    position = positions("uneven", 50)
    pairs = listed(position, position, 0.5).pairs(position, position)
    values = torch.rand(len(pairs.sender), *tail, dtype=torch.float64, requires_grad=True)
    expected = torch.zeros(50, *tail, dtype=torch.float64).index_add_(0, pairs.segment, values)
    assert torch.allclose(pairs.sum(values), expected)
    assert torch.autograd.gradcheck(pairs.sum, values)


@pytest.mark.parametrize("cutoff, skin", [(0.0, 0.1), (1.0, -0.1), (3.0, 0.2)])
def test_impossible_radii_are_refused(cutoff, skin):
    with pytest.raises(ValueError, match="half the box"):
        NeighborList(PeriodicBox(LENGTH), cutoff, skin)


def test_positions_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match="not finite"):
        listed(torch.full((2, 3), torch.nan), torch.zeros(2, 3), 1.0)
