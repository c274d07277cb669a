"""Slabs: which rank owns what, and the transpose between planes and columns."""

import numpy as np
import pytest

from eddies.parallel.slab import SlabDecomposition, Transpose, block_starts


def test_blocks_differ_by_at_most_one():
    for total, parts, starts in ((10, 3, [0, 4, 7, 10]), (2, 3, [0, 1, 2, 2]), (0, 2, [0, 0, 0])):
        assert block_starts(total, parts).tolist() == starts


@pytest.mark.mpi(1, 3)
def test_every_coordinate_has_the_owner_whose_bounds_hold_it(comm):
    slab = SlabDecomposition(comm, 2 * np.pi, 7)
    z = np.random.default_rng(1).uniform(0, slab.length, 1000)
    assert np.array_equal(slab.owner_of(z) == comm.rank, (z >= slab.lower) & (z < slab.upper))
    assert slab.owner_of(np.nextafter(slab.length, 0)) == comm.size - 1
    assert slab.owner_of(slab.lower) == comm.rank


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("rows, columns", [(7, 5), (2, 9)])
def test_every_value_comes_to_its_place_and_back(comm, rows, columns):
    # Two ranks get slabs of unequal height, and three of two rows leave one rank without any.
    whole = np.random.default_rng(2).standard_normal((3, rows, columns, 4))
    transpose = Transpose(comm, rows, columns, 3, 4, whole.dtype)
    z_starts, y_starts = block_starts(rows, comm.size), block_starts(columns, comm.size)
    own_rows, own_columns = (slice(*starts[comm.rank :][:2]) for starts in (z_starts, y_starts))
    for block, start, stop in zip(transpose.column_blocks, z_starts[:-1], z_starts[1:]):
        block[...] = whole[:, start:stop, own_columns]
    transpose.to_planes()
    assert np.array_equal(np.concatenate(transpose.plane_blocks, axis=2), whole[:, own_rows])
    for block in transpose.plane_blocks:
        block *= 2
    transpose.to_columns()
    assert np.array_equal(np.concatenate(transpose.column_blocks, axis=1), 2 * whole[:, :, own_columns])
