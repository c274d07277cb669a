import pytest
import torch

from eddies.particles.neighborhood import NeighborList
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
    assert len(pairs.sender) == 0 and pairs.sum(torch.ones(2, 0)).shape == (2, receivers)
    assert [*neighbors.blocks(10)][-1].stop == receivers


def test_blocks_cover_all_rows_once_with_about_as_many_pairs():
    position = positions("uneven", 300)
    neighbors = listed(position, position, 0.8)
    blocks = list(neighbors.blocks(100))
    assert [row for block in blocks for row in range(block.start, block.stop)] == list(range(300))
    most = int(neighbors.offsets.diff().max())
    sizes = [int(neighbors.offsets[block.stop] - neighbors.offsets[block.start]) for block in blocks]
    assert len(blocks) > 10 and max(sizes) <= 100 + most


@pytest.mark.parametrize("cutoff, skin", [(0.0, 0.1), (1.0, -0.1), (3.0, 0.2)])
def test_impossible_radii_are_refused(cutoff, skin):
    with pytest.raises(ValueError, match="half the box"):
        NeighborList(PeriodicBox(LENGTH), cutoff, skin)


def test_positions_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match="not finite"):
        listed(torch.full((2, 3), torch.nan), torch.zeros(2, 3), 1.0)
