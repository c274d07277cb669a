import numpy as np
import pytest

from eddies.parallel.reduction import any_rank, global_max, global_min, global_sum, sum_flat
from tests.parallel.counting import CountingComm


@pytest.mark.mpi(1, 3)
def test_reductions(comm):
    rank, size = comm.rank, comm.size
    assert global_sum(comm, np.array([1, rank])).tolist() == [size, size * (size - 1) // 2]
    assert global_max(comm, float(rank)) == size - 1
    assert global_min(comm, float(rank)) == 0
    assert any_rank(comm, rank == size - 1) and not any_rank(comm, False)


@pytest.mark.mpi(1, 3)
def test_flat_sum_adds_each_array_in_place_in_one_message(comm):
    arrays = [np.full((2, 3), 1.0 + comm.rank), np.zeros((0, 4)), np.array(2.0)]
    counting = CountingComm(comm)
    sum_flat(counting, arrays)
    assert np.all(arrays[0] == sum(1.0 + rank for rank in range(comm.size))) and arrays[2] == 2.0 * comm.size
    assert counting.sent == ([] if comm.size == 1 else ["Allreduce"])
