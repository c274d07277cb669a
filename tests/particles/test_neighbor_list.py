import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from eddies.particles.neighbor_list import NeighborList
from eddies.particles.periodic_box import PeriodicBox
from tests.particles.configurations import CONFIGURATIONS, LENGTH, positions


def listed(receivers, senders, cutoff, skin=0.0, exclude_self=True, periodic_z=True):
    neighbors = NeighborList(PeriodicBox(LENGTH, periodic_z), cutoff, skin)
    neighbors.build(receivers, senders, exclude_self)
    return neighbors


def as_set(pairs):
    found = list(zip(pairs.receiver.tolist(), pairs.sender.tolist()))
    assert len(found) == len(set(found)) and torch.all(torch.diff(pairs.segment) >= 0)
    return set(found)


def tree_pairs(receivers, senders, cutoff, exclude_self=True, periodic_z=True):
    """The pairs that a k-d tree finds."""
    # Unwrapped z does not fit into a periodic tree: a period much longer than the box never wraps.
    period = [LENGTH, LENGTH, LENGTH if periodic_z else 100 * LENGTH]
    shift = np.array([0, 0, 0 if periodic_z else 10 * LENGTH])
    tree = cKDTree((senders.numpy() + shift) % period, boxsize=period)
    found = tree.query_ball_point((receivers.numpy() + shift) % period, cutoff)
    return {(i, j) for i, row in enumerate(found) for j in row if not (exclude_self and i == j)}


@pytest.mark.parametrize("kind", CONFIGURATIONS)
@pytest.mark.parametrize("cutoff", [0.05, 1.3, LENGTH / 2 * 0.999])
def test_pairs_are_those_of_a_tree(kind, cutoff):
    position = positions(kind, 192)
    # No pair of the lattice exactly at the cutoff.
    cutoff = cutoff * 1.0123 if kind == "lattice" and cutoff < 2 else cutoff
    pairs = listed(position, position, cutoff).pairs(position, position)
    assert as_set(pairs) == tree_pairs(position, position, cutoff)


@pytest.mark.parametrize("periodic_z", [True, False])
def test_receivers_other_than_senders(periodic_z):
    senders = positions("uneven", 300) * torch.tensor([1.0, 1.0, 1.4]) - torch.tensor([0.0, 0.0, 1.0])
    points = positions("lattice", 128)
    pairs = listed(points, senders, 0.9, exclude_self=False, periodic_z=periodic_z).pairs(points, senders)
    assert as_set(pairs) == tree_pairs(points, senders, 0.9, exclude_self=False, periodic_z=periodic_z)


@pytest.mark.parametrize("receivers, senders", [(0, 0), (0, 5), (5, 0), (1, 1)])
def test_few_or_no_particles(receivers, senders):
    position = positions(count=5)
    neighbors = listed(position[:receivers], position[:senders], 1.0)
    pairs = neighbors.pairs(position[:receivers], position[:senders])
    assert len(pairs.sender) == 0 and pairs.sum(torch.ones(0, 2)).shape == (receivers, 2)
    assert [*neighbors.blocks(10)][-1].stop == receivers


def test_the_list_is_valid_while_nothing_moves_by_more_than_half_the_skin():
    position = positions(count=200)
    neighbors = listed(position, position, 0.9, skin=0.2)
    direction = torch.nn.functional.normalize(positions(count=200, seed=8) - LENGTH / 2)
    moved = position + 0.0999 * direction
    assert as_set(neighbors.pairs(moved, moved)) == tree_pairs(moved % LENGTH, moved % LENGTH, 0.9)


@pytest.mark.parametrize("recorded", [False, True])
@pytest.mark.parametrize("rows", [slice(20, 60), torch.tensor([7, 3, 190])], ids=["slice", "numbers"])
def test_pairs_of_some_receivers(rows, recorded):
    position = positions(count=200).requires_grad_(recorded)
    neighbors, number = listed(position, position, 1.0), torch.arange(200)[rows]
    pairs, everything = (neighbors.pairs(position, position, kept) for kept in (rows, None))
    assert pairs.count == len(number) and torch.equal(number[pairs.segment], pairs.receiver)
    assert as_set(pairs) == {pair for pair in as_set(everything) if pair[0] in number.tolist()}


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
