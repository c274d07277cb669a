import numpy as np
import pytest

from eddies.parallel.transpose import Transpose


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("rows, columns", [(7, 5), (8, 8), (2, 9)])
def test_every_value_comes_to_its_place_and_back(comm, rows, columns):
    # Two ranks get slabs of unequal height, and three of two rows leave one rank without any.
    whole = np.random.default_rng(2).standard_normal((3, rows, columns, 4))
    transpose = Transpose(comm, rows, columns)
    own_rows = slice(*transpose.z_starts[comm.rank : comm.rank + 2])
    own_columns = slice(*transpose.y_starts[comm.rank : comm.rank + 2])
    buffers = transpose.buffers(3, 4, whole.dtype)
    for block, start, stop in zip(buffers.column_blocks, transpose.z_starts[:-1], transpose.z_starts[1:]):
        block[...] = whole[:, start:stop, own_columns]
    buffers.to_planes()
    assert np.array_equal(np.concatenate(buffers.plane_blocks, axis=2), whole[:, own_rows])
    for block in buffers.plane_blocks:
        block *= 2
    buffers.to_columns()
    assert np.array_equal(np.concatenate(buffers.column_blocks, axis=1), 2 * whole[:, :, own_columns])
