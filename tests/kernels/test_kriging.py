"""Compiled weights of kriging, and their sums, against numpy, for each instruction set that this processor runs."""

import numpy as np
import pytest
import torch

from eddies.kernels.kriging import MOST_NEIGHBORS, kriging_weights, told
from eddies.particles.kriging import NOISE, Covariance
from eddies.particles.neighbor_list import NeighborList
from eddies.particles.periodic_box import PeriodicBox
from tests.kernels.reference_kriging import solved

SUPPORT, WIDTH = 0.4, 0.33
# Conditions are NOISE over the number of neighbours, some 2e-5, so that single precision keeps two digits.
TOLERANCE = {torch.float64: 1e-9, torch.float32: 2e-2}


def pairs(count, dtype, seed=1):
    """Those of points at random in a box of edge 1, of which some are alone in a corner that is else empty."""
    position = torch.from_numpy(np.random.default_rng(seed).random((count, 3)) * [1, 1, 0.5])
    position[:2] = torch.tensor([[0.1, 0.1, 0.95], [0.6, 0.6, 0.75]])
    listed = NeighborList(PeriodicBox(1.0), SUPPORT, 0.0)
    listed.build(position, position, exclude_self=True)
    return listed.pairs(position, position, dtype=dtype)


@pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
@pytest.mark.parametrize("count, width", [(2, WIDTH), (37, WIDTH), (300, WIDTH), (300, WIDTH / 2), (300, WIDTH / 30)])
def test_weights_are_those_of_dense_equations(library, count, width, dtype):
    """Neighbours up to 1.2 filter widths away, where the widest Gaussian is told by its series alone, and farther."""
    found_pairs, covariance = pairs(count, dtype), Covariance.of_filtered_turbulence(width)
    displacement = np.ascontiguousarray(found_pairs.displacement.T.numpy())
    found = kriging_weights(library, found_pairs.offsets.numpy(), displacement, SUPPORT, NOISE, covariance.slowest,
                            np.array(covariance.amplitudes))
    expected = solved(found_pairs.offsets, found_pairs.displacement, SUPPORT, covariance)
    for one, other in zip(found, expected):
        assert len(one) == len(other) == 10
        for row, of_row in zip(one, other):
            assert row.shape == of_row.shape and torch.from_numpy(row).dtype == dtype
            # Weights of a particle without neighbours are zero to rounding.
            assert np.linalg.norm(row - of_row) <= TOLERANCE[dtype] * (np.linalg.norm(of_row) + 1e-5)


@pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
def test_weights_do_not_depend_on_who_is_solved_for_beside(library, dtype):
    """Bit for bit, so that they are the same on any number of ranks."""
    together, covariance = pairs(60, dtype), Covariance.of_filtered_turbulence(WIDTH)
    offsets = together.offsets.numpy()

    def solve(offsets, displacement):
        return kriging_weights(library, offsets, np.ascontiguousarray(displacement.T.numpy()), SUPPORT, NOISE,
                               covariance.slowest, np.array(covariance.amplitudes))

    own, weights = solve(offsets, together.displacement)
    for receiver in range(len(offsets) - 1):
        listed = slice(offsets[receiver], offsets[receiver + 1])
        own_alone, alone = solve(np.array([0, listed.stop - listed.start]), together.displacement[listed])
        assert np.array_equal(own_alone[:, 0], own[:, receiver])
        assert all(np.array_equal(row_alone, row[listed]) for row_alone, row in zip(alone, weights))


@pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
def test_of_one_with_too_many_neighbours_nothing_is_told(library, dtype):
    """A crowd of more than there is memory for ends a run, and takes nothing from others."""
    few, crowd = pairs(37, dtype), MOST_NEIGHBORS + 1
    offsets = torch.cat([few.offsets, few.offsets[-1:] + crowd])
    away = torch.from_numpy(np.random.default_rng(2).normal(0, 0.1, (crowd, 3))).to(dtype)
    displacement = torch.cat([few.displacement, away])
    covariance = Covariance.of_filtered_turbulence(WIDTH)

    def told(offsets, displacement):
        found = kriging_weights(library, offsets.numpy(), np.ascontiguousarray(displacement.T.numpy()), SUPPORT, NOISE,
                                covariance.slowest, np.array(covariance.amplitudes))
        return [[np.stack(part) for part in way] for way in (found, solved(offsets, displacement, SUPPORT, covariance))]

    listed = int(few.offsets[-1])
    for (own, others), (own_of_few, of_few) in zip(told(offsets, displacement), told(few.offsets, few.displacement)):
        assert np.isnan(own[:, -1]).all() and np.isnan(others[:, listed:]).all()
        # Lanes are shared out otherwise, so that sums of single precision may round otherwise.
        assert np.allclose(own[:, :-1], own_of_few, rtol=1e-3, atol=1e-3)
        assert np.allclose(others[:, :listed], of_few, rtol=1e-3, atol=1e-3)


def test_arrays_of_another_kind_are_refused(library):
    offsets, amplitudes = np.array([0, 2]), np.ones(3) / 3
    for displacement in (np.zeros((2, 3)), np.zeros((3, 3)), np.zeros((3, 2), int), np.zeros((3, 4))[:, ::2]):
        with pytest.raises(ValueError, match="are needed"):
            kriging_weights(library, offsets, displacement, SUPPORT, NOISE, 1.0, amplitudes)
    with pytest.raises(ValueError, match="at most 8"):
        kriging_weights(library, offsets, np.zeros((3, 2)), SUPPORT, NOISE, 1.0, np.ones(9))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("rows", [1, 3, 10])
def test_what_weights_tell_is_their_sum(library, rows, dtype):
    """Of two fields, by receivers with no neighbour up to some vectors of them, one of which has weights that are no
    numbers."""
    random = np.random.default_rng(3)
    counts = np.array([0, 1, 15, 16, 17, 33, 64, 7, 0])
    offsets, seen = np.concatenate([[0], np.cumsum(counts)]), 40
    receivers, senders = np.repeat(np.arange(9), counts), random.integers(0, seen, offsets[-1])
    field = random.standard_normal((seen, 2)).astype(dtype)
    own, weights = (list(random.standard_normal((rows, size)).astype(dtype)) for size in (9, len(senders)))
    weights[-1][offsets[4] : offsets[5]] = np.nan
    found = told(library, offsets, senders, own, weights, field)
    assert found.shape == (9, 2, rows) and found.dtype == dtype
    for row in range(rows):
        expected = own[row][:, None].astype(float) * field[:9]
        np.add.at(expected, receivers, weights[row][:, None].astype(float) * field[senders])
        assert np.allclose(found[..., row], expected, rtol=0, atol=200 * np.finfo(dtype).eps, equal_nan=True)


def test_weights_and_fields_that_do_not_fit_are_refused(library):
    offsets, senders, field = np.array([0, 2]), np.array([1, 2]), np.zeros((3, 1))
    own, weights = [np.zeros(1)], [np.zeros(2)]
    for changed in ({"own": 2 * own, "weights": 2 * weights}, {"weights": []}, {"field": field.astype(np.float32)},
                    {"field": np.zeros(3)}, {"field": np.zeros((3, 2))[:, ::2]}, {"senders": senders.astype(np.int32)},
                    {"own": [np.zeros(3)[::2]]}, {"weights": [np.zeros(3)]}, {"offsets": np.array([0, 3])},
                    {"field": np.zeros((0, 1))}):
        arrays = {"offsets": offsets, "senders": senders, "own": own, "weights": weights, "field": field} | changed
        with pytest.raises(ValueError, match="are needed, of the precision of the field"):
            told(library, **arrays)
