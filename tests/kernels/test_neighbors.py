"""Compiled lists of neighbours and of pairs against those of torch, for each instruction set of this processor."""

import numpy as np
import pytest
import torch

from eddies.particles.neighbor_list import NeighborList
from eddies.particles.periodic_box import PeriodicBox
from tests.particles.configurations import CONFIGURATIONS, LENGTH, positions


def serve(monkeypatch, compiled):
    """Let lists be made by the library, or by torch."""
    monkeypatch.setattr("eddies.particles.neighbor_list.kernels_serve", lambda device: compiled)


def both(monkeypatch, library, box, radius, skin, *given, exclude_self):
    """Lists by torch and by the library."""
    made = []
    monkeypatch.setattr("eddies.particles.neighbor_list.library", lambda: library)
    for compiled in (False, True):
        serve(monkeypatch, compiled)
        made.append(NeighborList(box, radius, skin))
        made[-1].build(*given, exclude_self=exclude_self)
    return made


def sorted_pairs(pairs):
    """All columns of pairs, in order of receiver and sender."""
    order = np.lexsort((pairs.sender.numpy(), pairs.receiver.numpy()))
    return [column.numpy()[order] for column in (pairs.receiver, pairs.segment, pairs.sender, pairs.displacement,
                                                 pairs.distance)]


@pytest.mark.parametrize("periodic_z", [True, False])
@pytest.mark.parametrize("radius", [0.4, 1.5, 2.9])
@pytest.mark.parametrize("kind", CONFIGURATIONS)
def test_neighbours_are_those_of_torch(library, monkeypatch, kind, radius, periodic_z):
    """Of particles among themselves, of which both orders stand, and of other points outside of them."""
    box, points = PeriodicBox(LENGTH, periodic_z), positions(kind, 128)
    others = positions("even", 64, seed=9) * torch.tensor([1, 1, 1.4]) - 0.2
    for receivers, exclude_self in ((points, True), (others, False)):
        lists = both(monkeypatch, library, box, radius, 0.1, receivers, points, exclude_self=exclude_self)
        expected, found = lists
        assert torch.equal(found.offsets, expected.offsets)
        for i in range(len(receivers)):
            row = slice(expected.offsets[i], expected.offsets[i + 1])
            assert set(found.senders[row].tolist()) == set(expected.senders[row].tolist())
        moved = receivers + 0.04 * torch.sin(5 * receivers)
        for rows in (None, slice(3, 40), torch.tensor([5, 60, 7])):
            for once in (False, True) if exclude_self else (False,):
                for dtype in (torch.float64, torch.float32):
                    pairs = []
                    for compiled, listed in zip((False, True), lists):
                        serve(monkeypatch, compiled)
                        pairs.append(listed.pairs(moved, moved if exclude_self else points, rows, dtype, once))
                    one, other = map(sorted_pairs, pairs)
                    assert pairs[0].count == pairs[1].count
                    assert all(np.array_equal(a, b) for a, b in zip(one[:3], other[:3]))
                    rounding = 4 * torch.finfo(dtype).eps
                    assert all(a.dtype == b.dtype and np.allclose(a, b, rtol=0, atol=rounding)
                               for a, b in zip(one[3:], other[3:]))


def test_without_receivers_or_senders(library, monkeypatch):
    some, none = positions(count=20), torch.zeros(0, 3, dtype=torch.float64)
    for receivers, senders in ((some, none), (none, some), (none, none)):
        _, found = both(monkeypatch, library, PeriodicBox(LENGTH, False), 1.0, 0.0, receivers, senders,
                        exclude_self=False)
        assert found.offsets.tolist() == [0] * (len(receivers) + 1) and len(found.senders) == 0
        assert len(found.pairs(receivers, senders).sender) == 0
