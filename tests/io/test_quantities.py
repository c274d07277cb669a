import h5py
import pytest

from eddies.io.hdf5 import create_product, growing_dataset, write_table


@pytest.mark.mpi(1, 2)
def test_a_dataset_of_ones_own_is_written_as_it_is(comm, tmp_path):
    with create_product(comm, tmp_path / "own.h5", "rollout", {}) as file:
        write_table(file, "mine", {"number": [1.0, 2.0]})
        growing_dataset(file, "series", (3,), float)
    with h5py.File(tmp_path / "own.h5") as file:
        assert not file["mine/number"].attrs and not file["series"].attrs
