"""Rank 0 writes for all where HDF5 has no MPI: the same files, restarts and errors as with it."""

import h5py
import numpy as np
import pytest

from eddies.errors import UserError
from eddies.io import unfinished
from eddies.io.errors import WriteError
from eddies.io.hdf5 import append_frame, create_product, growing_dataset
from eddies.parallel.stop import StopRequest, Stopped
from eddies.scene.scene import load_scene
from eddies.stages import run_stages
from eddies.workflows import dns
from tests.io.test_unfinished import largest_file, write
from tests.small_scene import TINY, problems_of
from tests.workflows.stopping import StopAtStep
from tests.workflows.test_dns_restart import SPLIT, product


@pytest.fixture
def serial(monkeypatch):
    """A function after which h5py is one without MPI."""
    return lambda: monkeypatch.setattr(h5py, "get_config", lambda: type("Configuration", (), {"mpi": False}))


def content(path):
    """Datasets and attributes of all groups by path; but for what tells of the run itself."""
    found = {}

    def read(name, item):
        found.update({(name, key): np.array(value) for key, value in item.attrs.items()})
        if isinstance(item, h5py.Dataset):
            found[name] = item[()]

    with h5py.File(path) as file:
        file.visititems(read)
    return found


@pytest.mark.mpi(3)
def test_a_product_is_the_same(comm, tmp_path, serial):
    def write_parts(path):
        """Blocks cut along the last axis, of which rank 0 has none; then it has all."""
        with create_product(comm, path, "frames", {}) as file:
            dataset = growing_dataset(file, "values", (2, 3, 4), np.float64)
            cuts = [0, 0, 3, 4]
            mine = slice(cuts[comm.rank], cuts[comm.rank + 1])
            append_frame(dataset, np.arange(24.0).reshape(2, 3, 4)[:, :, mine], (0, 0, mine.start))
            append_frame(dataset, np.ones((2, 3, 4 if comm.rank == 0 else 0)), (0, 0, 0))

    for folder in ("parallel", "serial"):
        if comm.rank == 0:
            (tmp_path / folder).mkdir()
        comm.Barrier()
        write(comm, tmp_path / folder / "rollout.h5", 2)
        write_parts(tmp_path / folder / "parts.h5")
        serial()  # from the second on
    for name in ("rollout.h5", "parts.h5"):
        expected, found = content(tmp_path / "parallel" / name), content(tmp_path / "serial" / name)
        assert list(found) == list(expected)
        assert all(np.array_equal(found[path], values) for path, values in expected.items())
    assert np.array_equal(found["values"][0].ravel(), np.arange(24))
    comm.Barrier()
    assert sorted(path.name for path in (tmp_path / "serial").iterdir()) == ["parts.h5", "rollout.h5"]


@pytest.mark.mpi(2, timeout=60)
@pytest.mark.parametrize("taken", [True, False])
def test_a_full_disk_is_told_by_all_ranks(comm, tmp_path, serial, monkeypatch, taken):
    """Whether room can be taken beforehand or the disk fills while rank 0 writes."""
    serial()
    if not taken:
        monkeypatch.setattr(unfinished, "reserve", lambda *_: None)
        monkeypatch.setattr(unfinished, "check_limit", lambda *_: None)
    for size in (2**12, 3 * 2**20, 5 * 2**20 + 1):
        with largest_file(comm, size, 0), pytest.raises(WriteError, match="rollout.h5.partial: .*File too large.*room"):
            write(comm, tmp_path / "rollout.h5")
        assert list(tmp_path.iterdir()) == []
        comm.Barrier()


@pytest.mark.mpi(2)
def test_an_error_that_the_other_ranks_may_not_know_of_leaves_no_file_open(comm, tmp_path, serial):
    serial()
    with pytest.raises(ZeroDivisionError):
        with create_product(comm, tmp_path / "a.h5", "frames", {}) as file:
            1 / 0
    assert not file and not (tmp_path / "a.h5").exists()


@pytest.mark.mpi(2)
def test_a_stopped_simulation_goes_on_as_with_parallel_files(comm, tmp_path, serial):
    scene = load_scene(TINY, SPLIT)
    for name in ("parallel", "serial"):
        if comm.rank == 0:
            (tmp_path / name).mkdir()
        comm.Barrier()
        if name == "serial":
            serial()
            with pytest.raises(Stopped):
                dns.run(scene, comm, tmp_path / name, StopAtStep(comm, 14))  # within the time of the tracers
        dns.run(scene, comm, tmp_path / name)
    expected, found = product(comm, tmp_path / "parallel"), product(comm, tmp_path / "serial")
    assert all(np.array_equal(found[name], values) for name, values in expected.items())


@pytest.mark.mpi(2)
def test_what_is_too_large_for_one_rank_is_refused_before_any_work(comm, tmp_path, serial):
    scene = load_scene("hit-paper", ["flow.cells=512"])
    assert not any("built without MPI" in line for line in problems_of(scene, comm)[0])
    serial()
    line, *_ = problems_of(scene, comm)[0]
    assert line.startswith("hit-paper: ground_truth.h5: this h5py is built without MPI") and "up to 4 GB" in line
    assert problems_of(load_scene(TINY), comm)[0] == []
    with pytest.raises(UserError, match="hit-paper: ground_truth.h5: .* HDF5_MPI=ON"):
        run_stages(["dns"], scene, comm, tmp_path / "run", StopRequest(comm))
    assert not (tmp_path / "run").exists()
