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


@pytest.mark.mpi(1, 2)
def test_a_flow_says_its_units_its_box_and_what_t_0_is(comm, tmp_path):
    """Of a made-up kernel there is nothing to say."""
    for kind, origin in (("ground_truth", "the release of the tracers, at released_at"),
                         ("rollout", "the start of the rollout, at start_time"), ("kernel", None)):
        with create_product(comm, tmp_path / f"{kind}.h5", kind, {}):
            pass
        with h5py.File(tmp_path / f"{kind}.h5") as file:
            assert origin is None or origin in file.attrs["time_origin"] and "wrapped" in file.attrs["box"]
            assert {"units", "box", "time_origin"} & set(file.attrs) == ({"units", "box", "time_origin"} if origin
                                                                         else set())
