"""A disk that fills while a product is written: one error on all ranks, nothing harmed, nothing left, no crash."""

import os
import resource
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from eddies.io import unfinished
from eddies.io.checksums import FOOTER, count_blocks
from eddies.io.errors import WriteError
from eddies.io.fields import FieldWriter
from eddies.io.hdf5 import append_frame, create_product, growing_dataset, open_product, write_array, write_table
from eddies.io.sink import Sink
from eddies.io.trajectories import TrajectoryWriter
from eddies.io.unfinished import Unfinished
from mpi_tools.launch import mpi_environment, mpirun_command

MEBIBYTE = 2**20


@contextmanager
def largest_file(comm, size, rank):
    """A write limit for one rank, in place of a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    if comm.rank == rank:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
    comm.Barrier()


def write(comm, path, frames=4):
    """A product of all kinds of content, about 2 MiB a frame."""
    rows, cells = 60 // comm.size, 24
    with create_product(comm, path, "rollout", {"scene": "x" * 20000}) as file:
        particles = TrajectoryWriter(file, "model", 18000, 1.0, {"position": (3,), "density": ()}, np.float64)
        fields = FieldWriter(file, "model", cells, {"velocity": 3, "density": 1})
        values = growing_dataset(file, "values", (rows * comm.size, 2000), np.float64)
        share = 18000 // comm.size
        planes = cells // comm.size
        for frame in range(frames):
            particles.append(frame, 0.1 * frame, comm.rank * share,
                             {"position": np.full((share, 3), frame), "density": np.full(share, frame)})
            fields.append(0.1 * frame, comm.rank * planes,
                          {"velocity": np.full((3, planes, cells, cells), frame, np.float32),
                           "density": np.full((1, planes, cells, cells), frame, np.float32)})
            append_frame(values, np.full((rows, 2000), frame), (comm.rank * rows, 0))
        write_table(file, "statistics", {"time": np.arange(1000.0), "nothing": np.zeros((0, 2))})


@pytest.mark.mpi(1, 2, 3, timeout=60)
@pytest.mark.parametrize("size", [MEBIBYTE // 4, 3 * MEBIBYTE, 5 * MEBIBYTE + 1])
def test_a_full_disk_is_told_and_harms_nothing(comm, tmp_path, size):
    """The last rank alone meets its end."""
    path = tmp_path / "rollout.h5"
    if comm.rank == 0:
        path.write_text("older")
    comm.Barrier()
    with largest_file(comm, size, comm.size - 1):
        with pytest.raises(WriteError, match=r"rollout.h5.partial: cannot be written: File too large: \d+ bytes wanted"
                                             r", \d+ free; make room, then run the command again"):
            write(comm, path)
    assert path.read_text() == "older" and [found.name for found in tmp_path.iterdir()] == ["rollout.h5"]
    comm.Barrier()
    write(comm, path)
    with open_product(comm, path, "rollout") as file:
        assert np.all(file["particles/model/position/value"][3] == 3)


@pytest.mark.mpi(1)
def test_hdf5_survives_every_write_that_fails(comm, tmp_path, monkeypatch):
    """Where no room can be taken beforehand: the disk takes the first bytes, and then no more."""
    monkeypatch.setattr(unfinished, "reserve", lambda *_: None)
    monkeypatch.setattr(unfinished, "check_limit", lambda *_: None)
    path, written, sink_write = tmp_path / "rollout.h5", [], Sink.write
    monkeypatch.setattr(Sink, "write", lambda sink, data: written.append(1) or sink_write(sink, data))
    write(comm, path, 2)
    path.write_text("older")
    for allowed in range(0, len(written), 3):
        left = [allowed]

        def fail_later(sink, data):
            left[0] -= 1
            with largest_file(comm, 10**9 if left[0] >= 0 else 0, 0):
                return sink_write(sink, data)

        monkeypatch.setattr(Sink, "write", fail_later)
        with pytest.raises(WriteError, match="rollout.h5.partial: cannot be written: File too large"):
            write(comm, path, 2)
        assert path.read_text() == "older" and [found.name for found in tmp_path.iterdir()] == ["rollout.h5"]


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("shape, frames", [((), 1500), ((5,), 300), ((3, 20, 20, 20), 40), ((400000, 3), 2)])
def test_hdf5_stays_within_the_room_taken(comm, tmp_path, monkeypatch, shape, frames):
    """Half the margin is never used, whatever is written; what is left over is cut off at the end."""
    held = []

    def close(product, close=Unfinished.close):
        held.append(product._held)
        close(product)

    monkeypatch.setattr(Unfinished, "close", close)
    with create_product(comm, tmp_path / "a.h5", "frames", {}) as file:
        dataset = growing_dataset(file, "values", shape, np.float64)
        for _ in range(frames):
            append_frame(dataset, np.ones(shape if comm.rank == 0 else (0, *shape[1:])) if shape else np.ones(()),
                         (0,) * len(shape))
        write_array(file, "array", np.ones(1000))
        for number in range(20):
            write_table(file, f"table-{number}", {f"column-{column}": np.ones(7) for column in range(9)})
    size = (tmp_path / "a.h5").stat().st_size
    assert size < held[0] - unfinished.MARGIN_BYTES / 2
    with open_product(comm, tmp_path / "a.h5", "frames") as file:
        hdf5 = file.id.get_filesize()
        assert size == hdf5 + 4 * count_blocks(hdf5) + FOOTER.size and file["values"].shape[0] == frames


# On 3 MiB of its own, of which a part is taken: what is left at the end, and the error.
ON_A_SMALL_DISK = """
import os, subprocess, sys
from mpi4py import MPI
from eddies.io.errors import WriteError
from tests.io.test_unfinished import write
from pathlib import Path

disk = Path(sys.argv[1])
subprocess.run(["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", disk], check=True)
(disk / "older").write_bytes(bytes(int(sys.argv[2])))
try:
    write(MPI.COMM_WORLD, disk / "rollout.h5")
except WriteError as error:
    print(os.listdir(disk), error)
"""


@pytest.mark.parametrize("taken", [0, MEBIBYTE, 3 * MEBIBYTE])
def test_a_small_file_system_that_fills(tmp_path, taken):
    alone = ["unshare", "-m" if os.geteuid() == 0 else "-Urm"]
    if subprocess.run([*alone, "mount", "-t", "tmpfs", "tmpfs", tmp_path], capture_output=True).returncode:
        pytest.skip("no file system may be mounted here, not even in a namespace")
    line = [*alone, sys.executable, "-c", ON_A_SMALL_DISK, str(tmp_path), str(taken)]
    ended = subprocess.run(line, cwd=Path(__file__).parents[2], env=mpi_environment(1), capture_output=True, text=True,
                           timeout=50)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.startswith(f"['older'] {tmp_path}/rollout.h5.partial: cannot be written: No space left on")


PROGRAM = """
import resource, sys
import numpy as np
from eddies import cli
from eddies.parallel import connection
from eddies.io import unfinished
from eddies.io.checksums import FOOTER, count_blocks
from eddies.io.hdf5 import append_frame, create_product, growing_dataset
from eddies.workflows import dns

def run(scene, comm, directory, stop):
    with create_product(comm, directory / "ground_truth.h5", "ground_truth", {}) as file:
        dataset = growing_dataset(file, "values", (100000, 3), float)
        for frame in range(4):
            if frame == 2 and (comm.rank == 1 or sys.argv[2] == "all"):
                unfinished.check_limit = unfinished.reserve = lambda *_: None
                resource.setrlimit(resource.RLIMIT_FSIZE, (5_000_000, -1))
            append_frame(dataset, np.ones((50000, 3)), (50000 * comm.rank, 0))

dns.run, connection.PATIENCE = run, 0.5
sys.exit(cli.main(["dns", "tiny", "--output", sys.argv[1]]))
"""


@pytest.mark.parametrize("ranks", ["all", "one"])
def test_ranks_that_share_a_file_end_together_when_hdf5_cannot_write_it(tmp_path, ranks):
    """Where no room could be taken, and the disk fills: neither a crash nor a rank that waits for ever."""
    line = mpirun_command(2, [sys.executable, "-c", PROGRAM, str(tmp_path / "run"), ranks])
    ended = subprocess.run(line, env=mpi_environment(2), capture_output=True, text=True, timeout=50)
    told = [line for line in ended.stderr.splitlines() if "eddies: error: " in line]
    assert ended.returncode == 2 and len(told) == 1 and "bytes wanted" in told[0]
    assert "Traceback" not in ended.stderr and "Signal" not in ended.stderr
    assert not (tmp_path / "run/ground_truth.h5").exists()
