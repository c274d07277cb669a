import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from eddies.particles import neighbor_list
from eddies.particles.neighbor_list import NeighborList
from eddies.particles.periodic_box import PeriodicBox
from tests.particles.configurations import CONFIGURATIONS, LENGTH, positions


def listed(receivers, senders, cutoff, skin=0.0, exclude_self=True, periodic_z=True):
    neighbors = NeighborList(PeriodicBox(LENGTH, periodic_z), cutoff, skin)
    neighbors.build(receivers, senders, exclude_self)
    return neighbors


def as_set(pairs):
    found = list(zip(pairs.receiver.tolist(), pairs.sender.tolist()))
    assert len(found) == len(set(found))
    return set(found)


def oracle(receivers, senders, cutoff, exclude_self, periodic_z=True):
    """The pairs that a k-d tree finds."""
    # Unwrapped z does not fit into a periodic tree: a period much longer than the box never wraps.
    period = [LENGTH, LENGTH, LENGTH if periodic_z else 100 * LENGTH]
    shift = np.array([0, 0, 0 if periodic_z else 10 * LENGTH])
    tree = cKDTree((senders.numpy() + shift) % period, boxsize=period)
    found = tree.query_ball_point((receivers.numpy() + shift) % period, cutoff)
    return {(i, j) for i, row in enumerate(found) for j in row if not (exclude_self and i == j)}


@pytest.mark.parametrize("kind", CONFIGURATIONS)
@pytest.mark.parametrize("cutoff", [0.05, 0.47, 1.3, LENGTH / 2 * 0.999])
def test_pairs_are_those_of_a_tree(kind, cutoff):
    position = positions(kind, 192)
    # A lattice has pairs at exactly the cutoff of no interest here.
    cutoff = cutoff * 1.0123 if kind == "lattice" and cutoff < 2 else cutoff
    pairs = listed(position, position, cutoff).pairs(position, position)
    assert as_set(pairs) == oracle(position, position, cutoff, exclude_self=True)


@pytest.mark.parametrize("kind", ["even", "uneven"])
def test_receivers_other_than_senders(kind):
    senders, points = positions(kind, 300), positions("lattice", 128)
    pairs = listed(points, senders, 0.9, exclude_self=False).pairs(points, senders)
    assert as_set(pairs) == oracle(points, senders, 0.9, exclude_self=False)


def test_unwrapped_z_is_not_periodic():
    senders = positions(count=300) * torch.tensor([1.0, 1.0, 1.4]) - torch.tensor([0.0, 0.0, 1.0])
    receivers = senders[:150]
    pairs = listed(receivers, senders, 0.8, periodic_z=False).pairs(receivers, senders)
    assert as_set(pairs) == oracle(receivers, senders, 0.8, exclude_self=True, periodic_z=False)


@pytest.mark.parametrize("receivers, senders", [(0, 0), (0, 5), (5, 0), (1, 1)])
def test_few_or_no_particles(receivers, senders):
    position = positions(count=5)
    neighbors = listed(position[:receivers], position[:senders], 1.0)
    pairs = neighbors.pairs(position[:receivers], position[:senders])
    assert len(pairs.sender) == 0
    assert pairs.sum(torch.ones(0, 2)).shape == (receivers, 2)
    assert [block for block in neighbors.blocks(10)][-1].stop == receivers


@pytest.mark.parametrize("together", [1, 7, 1000])
def test_pairs_do_not_depend_on_how_many_are_searched_together(monkeypatch, together):
    position = positions("uneven", 150)
    whole = listed(position, position, 0.7)
    monkeypatch.setitem(neighbor_list.RECEIVERS_TOGETHER, "cpu", together)
    monkeypatch.setitem(neighbor_list.CANDIDATES_TOGETHER, "cpu", together)
    parts = listed(position, position, 0.7)
    assert torch.equal(whole.senders, parts.senders) and torch.equal(whole.offsets, parts.offsets)


def test_list_is_symmetric_sorted_and_compressed():
    position = positions("uneven", 250)
    neighbors = listed(position, position, 0.6, skin=0.2)
    receiver = torch.repeat_interleave(torch.arange(250), torch.diff(neighbors.offsets))
    pairs = set(zip(receiver.tolist(), neighbors.senders.tolist()))
    assert pairs == {(j, i) for i, j in pairs}
    assert torch.all(torch.diff(neighbors.pairs(position, position).segment) >= 0)


def test_list_holds_while_nothing_moves_by_more_than_half_the_skin():
    position = positions(count=200)
    neighbors = listed(position, position, 0.9, skin=0.2)
    direction = torch.nn.functional.normalize(positions(count=200, seed=8) - LENGTH / 2)
    moved = position + 0.0999 * direction
    assert as_set(neighbors.pairs(moved, moved)) == oracle(moved % LENGTH, moved % LENGTH, 0.9, True)


@pytest.mark.parametrize("rows", [slice(20, 60), torch.tensor([7, 3, 190])], ids=["slice", "numbers"])
def test_pairs_of_some_receivers(rows):
    position = positions(count=200)
    neighbors = listed(position, position, 1.0)
    number = torch.arange(200)[rows]
    pairs, everything = (neighbors.pairs(position, position, kept) for kept in (rows, None))
    assert pairs.count == len(number)
    assert torch.equal(number[pairs.segment], pairs.receiver)
    assert as_set(pairs) == {pair for pair in as_set(everything) if pair[0] in number.tolist()}


@pytest.mark.parametrize("rows", [None, slice(20, 60)], ids=["all", "slice"])
def test_each_pair_of_receivers_once_and_every_other_sender(rows):
    """Of 150 receivers among 200 senders."""
    position = positions(count=200)
    neighbors = listed(position[:150], position, 1.0)
    once, both = (as_set(neighbors.pairs(position[:150], position, rows, once=each)) for each in (True, False))
    assert once == {(i, j) for i, j in both if i < j} and any(j >= 150 for _, j in once)


@pytest.mark.parametrize("parity", [1.0, -1.0])
def test_values_of_pairs_that_stand_once_reach_both_particles_but_no_ghost(parity):
    position = positions(count=80)
    pairs = listed(position[:50], position, 1.5).pairs(position[:50], position, once=True)
    values = torch.rand(2, len(pairs.sender), dtype=torch.float64, requires_grad=True)

    def sums(values):
        totals = torch.zeros(2, 50, dtype=torch.float64)
        pairs.add_to_both(values, torch.tensor([1.0, parity], dtype=torch.float64), totals)
        return totals

    expected = torch.zeros(2, 50, dtype=torch.float64)
    for k, (i, j) in enumerate(zip(pairs.receiver.tolist(), pairs.sender.tolist())):
        expected[:, i] += values[:, k].detach()
        if j < 50:
            expected[0, j] += values[0, k].detach()
            expected[1, j] += parity * values[1, k].detach()
    assert torch.allclose(sums(values), expected)
    assert torch.autograd.gradcheck(sums, values)


def test_blocks_are_all_rows_once():
    position = positions("uneven", 300)
    neighbors = listed(position, position, 0.8)
    rows = [row for block in neighbors.blocks(100) for row in range(block.start, block.stop)]
    assert rows == list(range(300))


def test_displacements_are_differentiable_and_nearest():
    position = positions(count=60).requires_grad_()
    pairs = listed(position, position, 1.5).pairs(position, position)
    assert torch.allclose(pairs.distance, pairs.displacement.norm(dim=1))
    weight = torch.rand(len(pairs.sender), 3, dtype=torch.float64)
    (gradient,) = torch.autograd.grad((weight * pairs.displacement).sum(), position)
    expected = torch.zeros(60, 3, dtype=torch.float64)
    expected.index_add_(0, pairs.receiver, weight).index_add_(0, pairs.sender, -weight)
    assert torch.allclose(gradient, expected)


def test_single_precision_displacements_lose_nothing_to_the_box():
    position = positions(count=100)
    neighbors = listed(position, position, 1.0)
    single, double = (neighbors.pairs(position, position, dtype=t) for t in (torch.float32, torch.float64))
    assert single.displacement.dtype == single.distance.dtype == torch.float32
    assert torch.equal(single.displacement, double.displacement.to(torch.float32))


@pytest.mark.parametrize("tail", [(), (2,), (2, 3)])
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
