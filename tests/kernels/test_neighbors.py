"""Compiled lists of neighbours and of pairs against plain distances, for each instruction set of this processor."""

import pytest
import torch

from eddies.particles.neighborhood import NeighborList
from eddies.particles.periodic_box import PeriodicBox
from tests.particles.configurations import CONFIGURATIONS, LENGTH, positions


def listed(box, radius, skin, receivers, senders, exclude_self):
    neighbors = NeighborList(box, radius, skin)
    neighbors.build(receivers, senders, exclude_self)
    return neighbors


def near(box, receivers, senders, radius, exclude_self):
    """Whether each sender is within a radius of each receiver, (n, s)."""
    apart = box.displacement(receivers[:, None], senders).norm(dim=2) < radius
    return apart & ~torch.eye(*apart.shape, dtype=torch.bool) if exclude_self else apart


# Every configuration once with periodic z and once without, and radii from a tenth to almost half of the box.
CASES = [(kind, radius, periodic_z) for number, kind in enumerate(CONFIGURATIONS)
         for radius, periodic_z in (((0.4, 1.5, 2.9)[number % 3], True), ((2.9, 0.4, 1.5)[number % 3], False))]


@pytest.mark.parametrize("kind, radius, periodic_z", CASES)
def test_neighbours_are_those_of_plain_distances(library, monkeypatch, kind, radius, periodic_z):
    """Among particles, and around other points outside of them; pairs after a small motion, of all or some receivers,
    equal those that torch selects from the list."""
    if kind == "lattice":
        radius *= 1.01  # no pair exactly at the radius
    box, points = PeriodicBox(LENGTH, periodic_z), positions(kind, 128)
    others = positions("even", 64, seed=9) * torch.tensor([1, 1, 1.4]) - 0.2
    for receivers, exclude_self in ((points, True), (others, False)):
        neighbors = listed(box, radius, 0.1, receivers, points, exclude_self)
        rows = torch.repeat_interleave(torch.arange(len(receivers)), neighbors.offsets.diff())
        listed_pairs = torch.zeros(len(receivers), len(points), dtype=torch.bool)
        listed_pairs[rows, neighbors.senders] = True
        assert len(rows) == int(listed_pairs.sum())
        assert torch.equal(listed_pairs, near(box, receivers, points, (radius + 0.1) * (1 + 1e-9), exclude_self))
        moved = receivers + 0.04 * torch.sin(5 * receivers)
        senders = moved if exclude_self else points
        for kept in (None, slice(3, 40), torch.tensor([5, 60, 7])):
            for dtype in (torch.float64, torch.float32):
                pairs = neighbors.pairs(moved, senders, kept, dtype)
                with monkeypatch.context() as other:
                    other.setattr("eddies.particles.neighborhood.kernels_serve", lambda device: False)
                    expected = neighbors.pairs(moved, senders, kept, dtype)
                assert pairs.count == expected.count
                for name in ("receiver", "segment", "sender"):
                    assert torch.equal(getattr(pairs, name), getattr(expected, name))
                for name in ("displacement", "distance"):
                    torch.testing.assert_close(getattr(pairs, name), getattr(expected, name), rtol=0,
                                               atol=4 * torch.finfo(dtype).eps)


def test_without_receivers_or_senders(library):
    some, none = positions(count=20), torch.zeros(0, 3, dtype=torch.float64)
    for receivers, senders in ((some, none), (none, some), (none, none)):
        neighbors = listed(PeriodicBox(LENGTH, False), 1.0, 0.0, receivers, senders, False)
        assert neighbors.offsets.tolist() == [0] * (len(receivers) + 1) and len(neighbors.senders) == 0
        pairs = neighbors.pairs(receivers, senders)
        assert len(pairs.sender) == 0 and pairs.sum(torch.ones(2, 0)).shape == (2, len(receivers))
        assert [*neighbors.blocks(10)][-1].stop == len(receivers)
