"""Compiled kriging weights, and sums with them, against numpy."""

import numpy as np
import pytest
import torch

from eddies.kernels.kriging import MOST_NEIGHBORS, kriging_weights, weighted_sums
from eddies.particles.kriging import NOISE, covariance
from eddies.particles.neighborhood import NeighborList
from eddies.particles.periodic_box import PeriodicBox
from tests.kernels.reference_kriging import solved

SUPPORT, WIDTH = 0.4, 0.33
# The condition is NOISE over the number of neighbours, some 2e-5, so that single precision keeps two digits.
TOLERANCE = {torch.float64: 1e-9, torch.float32: 2e-2}


def pairs(count, dtype, seed=1):
    """Pairs of random points in half of a box of edge 1; two of the points are alone in the other half."""
    position = torch.from_numpy(np.random.default_rng(seed).random((count, 3)) * [1, 1, 0.5])
    position[:2] = torch.tensor([[0.1, 0.1, 0.95], [0.6, 0.6, 0.75]])
    listed = NeighborList(PeriodicBox(1.0), SUPPORT, 0.0)
    listed.build(position, position, exclude_self=True)
    return listed.pairs(position, position, dtype=dtype)


def weights(offsets, displacement, width=WIDTH, sited=True):
    return kriging_weights(np.asarray(offsets), np.ascontiguousarray(displacement.T.numpy()), SUPPORT, NOISE,
                           *covariance(width), sited)


@pytest.mark.parametrize("count, width, sited, dtype", [
    (2, WIDTH, True, torch.float64), (37, WIDTH, False, torch.float64), (37, WIDTH, False, torch.float32),
    (120, WIDTH, True, torch.float64), (60, WIDTH, True, torch.float32), (60, WIDTH / 30, True, torch.float64)])
def test_weights(library, count, width, sited, dtype):
    """Neighbours up to 1.2 filter widths away, where a series replaces the widest Gaussian, and farther."""
    listed = pairs(count, dtype)
    compiled = weights(listed.offsets, listed.displacement, width, sited)
    expected = solved(listed.offsets, listed.displacement, SUPPORT, width, sited)
    for one, other in zip(compiled if sited else compiled[1:], expected if sited else expected[1:]):
        assert len(one) == len(other) == 10
        for row, of_row in zip(one, other):
            assert row.shape == of_row.shape and torch.from_numpy(row).dtype == dtype
            # The derivatives at a particle without neighbours are rounding errors.
            assert np.linalg.norm(row - of_row) <= TOLERANCE[dtype] * (np.linalg.norm(of_row) + 1e-5)


@pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
def test_weights_of_a_receiver_do_not_depend_on_the_others(library, dtype):
    """Bit for bit, so that they are the same on any number of ranks."""
    together = pairs(60, dtype)
    offsets = together.offsets.numpy()
    own, others = weights(offsets, together.displacement)
    for receiver in range(len(offsets) - 1):
        listed = slice(offsets[receiver], offsets[receiver + 1])
        own_alone, alone = weights([0, listed.stop - listed.start], together.displacement[listed])
        assert np.array_equal(own_alone[:, 0], own[:, receiver])
        assert all(np.array_equal(row_alone, row[listed]) for row_alone, row in zip(alone, others))


@pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
def test_too_many_neighbours_give_nan_for_that_receiver_only(library, dtype):
    few, crowd = pairs(37, dtype), MOST_NEIGHBORS + 1
    offsets, listed = torch.cat([few.offsets, few.offsets[-1:] + crowd]), int(few.offsets[-1])
    away = torch.from_numpy(np.random.default_rng(2).normal(0, 0.1, (crowd, 3))).to(dtype)
    displacement = torch.cat([few.displacement, away])
    of_few = weights(few.offsets, few.displacement)
    for own, others in (weights(offsets, displacement),
                        solved(offsets, displacement, SUPPORT, WIDTH)):
        own, others = np.stack([*own]), np.stack([*others])
        assert np.isnan(own[:, -1]).all() and np.isnan(others[:, listed:]).all()
        # Receivers share vectors in another way, so that sums in single precision may round differently.
        assert np.allclose(own[:, :-1], of_few[0], rtol=1e-3, atol=1e-3)
        assert np.allclose(others[:, :listed], of_few[1], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("rows, dtype", [(1, np.float64), (3, np.float32), (4, np.float64), (10, np.float32)])
def test_weighted_sums(library, rows, dtype):
    """Two fields; receivers with no neighbour up to some vectors of them; the weights of one are NaN."""
    random = np.random.default_rng(3)
    counts = np.array([0, 1, 15, 16, 17, 33, 64, 7, 0])
    offsets, senders = np.concatenate([[0], np.cumsum(counts)]), random.integers(0, 40, counts.sum())
    field = random.standard_normal((40, 2)).astype(dtype)
    own, others = (list(random.standard_normal((rows, size)).astype(dtype)) for size in (9, len(senders)))
    others[-1][offsets[4] : offsets[5]] = np.nan
    sums = weighted_sums(offsets, senders, own, others, field)
    assert sums.shape == (9, 2, rows) and sums.dtype == dtype
    for row in range(rows):
        expected = own[row][:, None].astype(float) * field[:9]
        np.add.at(expected, np.repeat(np.arange(9), counts), others[row][:, None].astype(float) * field[senders])
        assert np.allclose(sums[..., row], expected, rtol=0, atol=200 * np.finfo(dtype).eps, equal_nan=True)
