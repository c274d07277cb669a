import numpy as np
import pytest

from eddies.parallel.reduction import global_sum
from eddies.parallel.transpose import Transpose


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("rows, columns", [(7, 5), (8, 8), (2, 9)])
def test_transpose_moves_every_value_and_backward_inverts_it(comm, rows, columns):
    whole = np.random.default_rng(2).standard_normal((3, rows, columns, 4))
    transpose = Transpose(comm, rows, columns)
    mine = whole[:, transpose.z_starts[comm.rank] : transpose.z_starts[comm.rank + 1]]
    turned = transpose.forward(mine)
    assert np.array_equal(turned, whole[:, :, transpose.y_starts[comm.rank] : transpose.y_starts[comm.rank + 1]])
    assert np.array_equal(transpose.backward(turned), mine)


@pytest.mark.mpi(1, 2, 3)
def test_backward_is_the_adjoint_of_forward(comm):
    random = np.random.default_rng(comm.rank)
    transpose = Transpose(comm, 7, 5)
    x = random.standard_normal((2, transpose.z_count, 5, 3))
    y = random.standard_normal((2, 7, transpose.y_count, 3))
    left, right = global_sum(comm, np.array([np.vdot(transpose.forward(x), y), np.vdot(x, transpose.backward(y))]))
    assert left == pytest.approx(right, rel=1e-13)
