"""Files are complete or absent: on full disks, and after errors."""

import errno
import os
import stat
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

import eddies
from eddies.errors import UserError
from eddies.io import new_files
from eddies.io.damage import find_damage, open_to_read
from eddies.io.errors import WriteError, write_error
from eddies.io.fields import FieldWriter
from eddies.io.hdf5 import (append_frame, create_product, growing_dataset, in_files, open_product, write_array,
                            write_table)
from eddies.io.new_files import MARGIN_BYTES, write_files
from eddies.io.trajectories import TrajectoryWriter
from tests.commands import first_rank, on_ranks, python, refused, run_cli
from tests.full_disk import largest_file

SIZES = 2**12, 5 * 2**20 + 1  # of the largest file: at the beginning, and in the frames


def write(comm, path, frames=4):
    """A product with all kinds of content, about 2 MiB a frame."""
    rows, cells = 60 // comm.size, 24
    with create_product(comm, path, "rollout", {"scene": "x" * 20000}) as file:
        particles = TrajectoryWriter(file, "model", 18000, 1.0, {"position": (3,), "density": ()}, np.float64)
        fields = FieldWriter(file, "model", cells, {"velocity": 3, "density": 1})
        values = growing_dataset(file, "values", (rows * comm.size, 2000), np.float64)
        share, planes = 18000 // comm.size, cells // comm.size
        for frame in range(frames):
            particles.append(frame, 0.1 * frame, comm.rank * share,
                             {"position": np.full((share, 3), frame), "density": np.full(share, frame)})
            fields.append(0.1 * frame, comm.rank * planes,
                          {"velocity": np.full((3, planes, cells, cells), frame, np.float32),
                           "density": np.full((1, planes, cells, cells), frame, np.float32)})
            append_frame(values, np.full((rows, 2000), frame), (comm.rank * rows, 0))
        write_table(file, "statistics", {"time": np.arange(1000.0), "nothing": np.zeros((0, 2))})


@pytest.mark.mpi(1, 2, 3, timeout=60)
def test_a_full_disk_is_told_and_harms_nothing(comm, tmp_path):
    """The last rank alone meets the limit."""
    path = tmp_path / "rollout.h5"
    first_rank(comm, path.write_text, "older")
    for size in SIZES:
        with largest_file(comm, size, comm.size - 1):
            with pytest.raises(WriteError, match=r"rollout.h5.partial: .*: \d+ bytes wanted, \d+ free; make room"):
                write(comm, path)
        assert path.read_text() == "older" and [file.name for file in tmp_path.iterdir()] == ["rollout.h5"]
        comm.Barrier()
    write(comm, path)
    with open_product(comm, path, "rollout") as file:
        assert np.all(file["particles/model/position/value"][3] == 3)


@pytest.mark.mpi(2)
@pytest.mark.parametrize("shape, frames", [((5,), 200), ((400000, 3), 2)])
def test_hdf5_stays_within_the_reserved_space(comm, tmp_path, monkeypatch, shape, frames):
    """HDF5 never uses half of the margin. What it does not need is cut off."""
    reserved, close = [], new_files._NewFile.close
    monkeypatch.setattr(new_files._NewFile, "close", lambda new: reserved.append(new._reserved) or close(new))
    with create_product(comm, tmp_path / "a.h5", "frames", {}) as file:
        dataset, single = growing_dataset(file, "values", shape, np.float64), growing_dataset(file, "time", (), float)
        for _ in range(frames):
            append_frame(dataset, np.ones(shape if comm.rank == 0 else (0, *shape[1:])), (0,) * len(shape))
            append_frame(single, np.ones(()), ())
        write_array(file, "array", np.ones(1000))
        for number in range(10):
            write_table(file, f"table-{number}", {f"column-{column}": np.ones(7) for column in range(9)})
    size = (tmp_path / "a.h5").stat().st_size
    assert size < reserved[0] - MARGIN_BYTES / 2
    with open_product(comm, tmp_path / "a.h5", "frames") as file:
        assert size == file.id.get_filesize() and file["values"].shape[0] == frames


@pytest.mark.mpi(2)
def test_a_file_is_forced_to_the_disk_before_it_gets_its_name(comm, tmp_path, monkeypatch):
    """By every rank, which may be on another node; then the name is, by rank 0."""
    done, fsync, replace, folder = [], os.fsync, os.replace, tmp_path.resolve()
    monkeypatch.setattr(os, "fsync", lambda file: done.append(os.readlink(f"/proc/self/fd/{file}")) or fsync(file))
    monkeypatch.setattr(os, "replace", lambda *paths: done.append("named") or replace(*paths))
    with create_product(comm, tmp_path / "a.h5", "frames", {}):
        pass
    assert done == [f"{folder}/a.h5.partial", "named", str(folder)][:3 if comm.rank == 0 else 1]


# On a file system of 3 MiB: the files that are left, and the error.
ON_A_SMALL_DISK = """
import os, subprocess, sys
from mpi4py import MPI
from eddies.io.errors import WriteError
from tests.io.test_new_files import write
from pathlib import Path

disk = Path(sys.argv[1])
subprocess.run(["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", disk], check=True)
(disk / "older").write_bytes(bytes(2**20))
try:
    write(MPI.COMM_WORLD, disk / "rollout.h5")
except WriteError as error:
    print(os.listdir(disk), error)
"""


def test_a_small_file_system_that_fills(tmp_path):
    alone = ["unshare", "-m" if os.geteuid() == 0 else "-Urm"]
    if subprocess.run([*alone, "mount", "-t", "tmpfs", "tmpfs", tmp_path], capture_output=True).returncode:
        pytest.skip("no file system may be mounted here, not even in a namespace")
    line = [*alone, sys.executable, "-c", ON_A_SMALL_DISK, str(tmp_path)]
    ended = subprocess.run(line, cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=50)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.startswith(f"['older'] {tmp_path}/rollout.h5.partial: ") and "No space left" in ended.stdout


# The last rank cannot write any more from the third frame on, although space was reserved.
PROGRAM = """
import resource, sys
import numpy as np
from eddies import cli
from eddies.parallel import broadcast
from eddies.io import new_files
from eddies.io.hdf5 import append_frame, create_product, growing_dataset
from eddies.workflows import dns

def run(scene, comm, directory, stop):
    with create_product(comm, directory / "ground_truth.h5", "ground_truth", {}) as file:
        dataset = growing_dataset(file, "values", (50000 * comm.size, 3), float)
        for frame in range(4):
            if frame == 2 and comm.rank == comm.size - 1:
                new_files._NewFile._reserve_until = lambda *_: None
                resource.setrlimit(resource.RLIMIT_FSIZE, (2_500_000 * comm.size, -1))
            append_frame(dataset, np.ones((50000, 3)), (50000 * comm.rank, 0))

dns.run, broadcast.PATIENCE = run, 0.5
sys.exit(cli.main(["dns", "tiny", "--output", sys.argv[1]]))
"""


@pytest.mark.parametrize("ranks", [1, 2])
def test_ranks_end_together_when_hdf5_cannot_write_their_file(tmp_path, ranks):
    """HDF5 does not crash, and no rank waits for ever."""
    ended = on_ranks(ranks, "-c", PROGRAM, tmp_path / "run")
    errors = [line for line in ended.stderr.splitlines() if "eddies: error: " in line]
    assert ended.returncode == 2 and len(errors) == 1 and "bytes wanted" in errors[0]
    assert "Traceback" not in ended.stderr and "Signal" not in ended.stderr
    assert not (tmp_path / "run/ground_truth.h5").exists()


# A write fails, and the file stays open until the process ends. Meanwhile the product is made again.
AGAIN = """
import resource, signal, sys
from pathlib import Path
import numpy as np
from mpi4py import MPI
from eddies.io import new_files
from eddies.io.errors import ProductError
from eddies.io.hdf5 import create_product, write_array

def make(value):
    with create_product(MPI.COMM_WORLD, Path(sys.argv[1]) / "kernel.h5", "kernel", {}) as file:
        write_array(file, "values", np.full(300_000, value))

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
reserve, new_files._NewFile._reserve_until = new_files._NewFile._reserve_until, lambda *_: None
resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, -1))
try:
    make(1.0)
except ProductError:
    assert new_files.writing_failed()
resource.setrlimit(resource.RLIMIT_FSIZE, (-1, -1))
new_files._NewFile._reserve_until = reserve
make(2.0)
print("made")
"""


def test_a_file_that_was_left_open_does_not_harm_the_next_one(tmp_path):
    """HDF5 writes into the open file at the end of the process, and may crash then."""
    ended = python("-c", AGAIN, tmp_path)
    assert ended.stdout == "made\n", ended.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["kernel.h5"]
    with open_to_read(tmp_path / "kernel.h5") as file:
        assert np.all(file["values"][:] == 2.0)


@pytest.mark.mpi(2)
def test_a_failing_close_does_not_hide_the_error(comm, tmp_path, monkeypatch):
    """The last rank alone meets it; all keep the file until the process ends."""
    abandoned, close = [], new_files._NewFile.close

    def failing(new):
        close(new)
        if comm.rank == comm.size - 1:
            raise RuntimeError("cannot be closed")

    monkeypatch.setattr(new_files, "_abandoned", abandoned)
    with monkeypatch.context() as patch:
        patch.setattr(new_files._NewFile, "close", failing)
        with pytest.raises(WriteError, match="the first error"), create_product(comm, tmp_path / "a.h5", "frames", {}):
            raise WriteError("the first error")
    assert new_files.writing_failed() and [new.path.name for new in abandoned] == ["a.h5.partial"]


@pytest.mark.mpi(1)
def test_a_directory_need_not_be_forced_to_the_disk(comm, tmp_path, monkeypatch):
    """Some file systems refuse it; then the product is complete. For the file itself it is an error."""
    fsync = os.fsync

    def refusing(kind):
        def act(descriptor):
            if kind(os.fstat(descriptor).st_mode):
                raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
            fsync(descriptor)

        return act

    monkeypatch.setattr(os, "fsync", refusing(stat.S_ISDIR))
    with create_product(comm, tmp_path / "a.h5", "frames", {}):
        pass
    assert find_damage(comm, tmp_path / "a.h5") is None
    monkeypatch.setattr(os, "fsync", refusing(stat.S_ISREG))
    with pytest.raises(WriteError), create_product(comm, tmp_path / "b.h5", "frames", {}):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5"]


def test_an_unknown_size_is_not_told(tmp_path):
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert "No space left on device: 7 bytes wanted, " in str(write_error(tmp_path / "a", full, 7))
    assert "wanted" not in str(write_error(tmp_path / "a", full))


@pytest.mark.mpi(1, 2)
def test_several_ranks_need_an_h5py_with_mpi(comm, tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(h5py, "get_config", lambda: SimpleNamespace(mpi=False))
    command = ["dns", "abc", "--set", "time.duration=0.1", "--output", tmp_path / "run"]
    if comm.size == 1:
        assert run_cli(*command) == 0 and (tmp_path / "run/ground_truth.h5").exists()
    else:
        refused(comm, capfd, command, "2 ranks need an h5py with MPI", "mpi_tools/bootstrap.sh", "HDF5_MPI=ON")
        with pytest.raises(UserError, match="an h5py with MPI"):
            eddies.run("abc", output=tmp_path / "run", comm=comm)
        assert not (tmp_path / "run").exists()


@pytest.mark.mpi(2)
def test_small_files_are_all_written_or_none(comm, tmp_path):
    page, data = tmp_path / "page.html", tmp_path / "metrics.json"
    in_files(comm, tmp_path, lambda: write_files({page: "ä", data: b"\0\1"}))
    for limit in (0, 5000):  # the second one suffices for the first file
        with largest_file(comm, limit), pytest.raises(UserError, match=r"7007 bytes wanted, \d+ free; make room"):
            in_files(comm, tmp_path, lambda: write_files({page: "newer!!", data: "x" * 7000}))
        assert sorted(tmp_path.iterdir()) == [data, page]
        assert page.read_text(encoding="utf-8") == "ä" and data.read_bytes() == b"\0\1"
        comm.Barrier()  # before rank 0 writes again


@pytest.mark.mpi(1)
def test_a_name_that_is_not_utf_8_is_escaped_in_a_text(comm, tmp_path):
    write_files({tmp_path / "scene.toml": "directory: out\udcff, ä"})
    assert (tmp_path / "scene.toml").read_text(encoding="utf-8") == "directory: out\\udcff, ä"
