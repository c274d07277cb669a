"""Compiled lists of neighbours and of pairs against torch."""

import numpy as np
import pytest
import torch

from eddies.particles.neighbor_list import NeighborList
from eddies.particles.periodic_box import PeriodicBox
from tests.particles.configurations import CONFIGURATIONS, LENGTH, positions


@pytest.fixture
def both(library, monkeypatch):
    """A function that returns what a function gives by torch, and by the library."""
    monkeypatch.setattr("eddies.particles.neighbor_list.library", lambda: library)

    def call(function):
        results = []
        for compiled in (False, True):
            monkeypatch.setattr("eddies.particles.neighbor_list.kernels_serve", lambda device: compiled)
            results.append(function())
        return results

    return call


def listed(box, radius, receivers, senders, exclude_self):
    found = NeighborList(box, radius, 0.1)
    found.build(receivers, senders, exclude_self=exclude_self)
    return found


def sorted_pairs(pairs):
    """All columns of pairs, in order of receiver and sender."""
    order = np.lexsort((pairs.sender.numpy(), pairs.receiver.numpy()))
    return [column.numpy()[order] for column in (pairs.receiver, pairs.segment, pairs.sender, pairs.displacement,
                                                 pairs.distance)]


@pytest.mark.parametrize("kind, radius, periodic_z", [
    *((kind, 1.5, True) for kind in CONFIGURATIONS), ("even", 0.4, True), ("uneven", 2.9, True), ("even", 1.5, False),
    ("cluster across a corner", 2.9, False)])
def test_neighbours_and_pairs(both, kind, radius, periodic_z):
    """Particles among themselves, and around other points outside of the box."""
    box, points = PeriodicBox(LENGTH, periodic_z), positions(kind, 128)
    others = positions("even", 64, seed=9) * torch.tensor([1, 1, 1.4]) - 0.2
    for receivers, exclude_self in ((points, True), (others, False)):
        lists = both(lambda: listed(box, radius, receivers, points, exclude_self))
        expected, found = lists
        assert torch.equal(found.offsets, expected.offsets)
        for i in range(len(receivers)):
            row = slice(expected.offsets[i], expected.offsets[i + 1])
            assert set(found.senders[row].tolist()) == set(expected.senders[row].tolist())
        moved = receivers + 0.04 * torch.sin(5 * receivers)
        for rows, once, dtype in ((None, exclude_self, torch.float64), (slice(3, 40), False, torch.float32),
                                  (torch.tensor([5, 60, 7]), exclude_self, torch.float64)):
            given = moved, moved if exclude_self else points, rows, dtype, once
            one, other = map(sorted_pairs, both(lambda: found.pairs(*given)))
            assert all(np.array_equal(a, b) for a, b in zip(one[:3], other[:3]))
            for a, b in zip(one[3:], other[3:]):
                assert a.dtype == b.dtype and np.allclose(a, b, rtol=0, atol=4 * torch.finfo(dtype).eps)


def test_without_receivers_or_senders(both):
    some, none = positions(count=20), torch.zeros(0, 3, dtype=torch.float64)
    for receivers, senders in ((some, none), (none, some), (none, none)):
        for found in both(lambda: listed(PeriodicBox(LENGTH, False), 1.0, receivers, senders, False)):
            assert found.offsets.tolist() == [0] * (len(receivers) + 1) and len(found.senders) == 0
            assert len(found.pairs(receivers, senders).sender) == 0
