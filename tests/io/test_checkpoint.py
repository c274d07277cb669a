"""Checkpoints are complete and undamaged, or are not used."""

import errno
import os
import random
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from eddies.io import damage
from eddies.io.checkpoint import Block, CheckpointDirectory, Guard, checkpoints_in
from eddies.io.errors import ProductError, WriteError
from eddies.io.hdf5 import create_product, write_table
from eddies.parallel.slab import block_starts
from eddies.parallel.stop import Stopped, StopRequest
from tests.commands import first_rank
from tests.full_disk import largest_file

SHAPE = (3, 5, 7, 4)  # seven rows along the axis that is cut


def arrays(comm, step):
    """Modes, rows of particles, of which the first of three ranks has none, and numbers that the ranks measured."""
    generator = np.random.default_rng(step)
    modes = generator.standard_normal(SHAPE) + 1j * generator.standard_normal(SHAPE)
    rows, table = generator.standard_normal((10, 3)), generator.standard_normal(6)
    cuts = block_starts(7, comm.size)[comm.rank:comm.rank + 2], ([0, 0, 4, 10] if comm.size == 3 else block_starts(
        10, comm.size))[comm.rank:comm.rank + 2]
    return {"modes": Block(modes[:, :, slice(*cuts[0])], int(cuts[0][0]), 7, axis=2),
            "position": Block(rows[slice(*cuts[1])], int(cuts[1][0]), 10), "table": table + comm.rank,
            "seconds": 10**(9 * comm.rank), "nothing": np.zeros((0, 2))}, modes, rows


def fill(comm, path, steps, fingerprint="settings"):
    directory = CheckpointDirectory(comm, path / "checkpoints", fingerprint)
    for step in steps:
        directory.write(step, {"time": step / 3, "end": np.inf, **arrays(comm, step)[0]})
    comm.Barrier()
    return directory


@pytest.mark.mpi(1, 3)
def test_what_is_read_is_what_was_written(comm, tmp_path):
    """The numbers that are no blocks are those of rank 0."""
    saved = fill(comm, tmp_path, [200]).newest()
    _, modes, rows = arrays(comm, 200)
    assert (saved["time"], saved["end"]) == (200 / 3, np.inf) and saved.files == []
    assert set(saved) == {"time", "end", "seconds", "modes", "position", "table", "nothing"} and len(saved) == 7
    assert "modes" in saved and "time" in saved and "mode" not in saved
    assert np.allclose(saved["table"], arrays(comm, 200)[0]["table"] - comm.rank) and saved["seconds"] == 1
    assert np.array_equal(saved.read("modes"), modes) and saved.read("modes").dtype == np.complex128
    assert np.array_equal(saved.read("modes", 2, 5, axis=2), modes[:, :, 2:5])
    assert np.array_equal(saved.read("position"), rows) and np.array_equal(saved.read("position", 3, 4), rows[3:4])
    assert saved.read("nothing").shape == (0, 2)


@pytest.mark.mpi(2)
def test_the_newest_three_are_kept(comm, tmp_path):
    directory = fill(comm, tmp_path, [1, 2, 3, 10, 11])
    assert sorted(path.name for path in directory.path.iterdir()) == [f"step-{n:08d}.h5" for n in (3, 10, 11)]
    assert checkpoints_in(directory.path) == [(11, "settings"), (10, "settings"), (3, "settings")]
    assert directory.newest().content["step"] == 11
    directory.remove()
    assert not directory.path.exists()


@pytest.mark.mpi(2)
def test_a_checkpoint_of_other_settings_or_with_damage_is_replaced(comm, tmp_path):
    """The present state must not be lost. A checkpoint of this step and these settings holds it, and is kept."""
    fill(comm, tmp_path, [5], "others")
    directory = fill(comm, tmp_path, [5])
    assert checkpoints_in(directory.path) == [(5, "settings")]
    path = directory.path / "step-00000005.h5"
    written = path.stat().st_mtime_ns
    comm.Barrier()
    directory.write(5, {"time": -1.0})
    assert path.stat().st_mtime_ns == written and directory.newest()["time"] == 5 / 3
    first_rank(comm, path.write_bytes, path.read_bytes()[:-100])
    assert fill(comm, tmp_path, [5]).newest()["time"] == 5 / 3


@pytest.mark.mpi(2)
def test_which_checkpoints_are_used(comm, tmp_path, caplog, monkeypatch):
    """Checkpoints of other kernels are used with a warning. Leftovers, other names, and those of other settings and
    versions are removed."""
    directory = fill(comm, tmp_path, [1])
    if comm.rank == 0:
        (directory.path / "step-00000002.h5.partial").write_bytes(b"half")
        (directory.path / "frames-00000001.h5").write_bytes(b"later than the checkpoint")
        (directory.path / "step-00000003").mkdir()  # as of version 1
        shutil.copy(directory.path / "step-00000001.h5", directory.path / "step-00000010-backup")
        for name in ("step-00000011.h5", "step-00000012-backup", "step-last"):
            (directory.path / name).mkdir()
        assert checkpoints_in(directory.path) == [(3, ""), (1, "settings")]
    comm.Barrier()
    with monkeypatch.context() as patch:
        patch.setattr("eddies.io.checkpoint.in_use", lambda: "another")
        assert directory.newest().content["step"] == 1
    assert [path.name for path in directory.path.iterdir()] == ["step-00000001.h5"]
    assert comm.rank > 0 or "compiled kernels: another" in caplog.text and "the last digits" in caplog.text
    assert comm.rank > 0 or "step-00000003: was made by another version" in caplog.text
    comm.Barrier()
    assert CheckpointDirectory(comm, directory.path, "others").newest() is None
    assert comm.rank > 0 or "step-00000001.h5: was made with other settings" in caplog.text
    assert list(directory.path.iterdir()) == []
    comm.Barrier()
    monkeypatch.setattr("eddies.io.checkpoint.FORMAT", 1)
    directory = fill(comm, tmp_path, [1])
    monkeypatch.undo()
    assert directory.newest() is None
    assert comm.rank > 0 or "step-00000001.h5: was made by another version" in caplog.text


@pytest.mark.mpi(2)
@pytest.mark.parametrize("name, rank", [("step-00000002.h5", 0), ("frames-00000000.h5", -1)])
def test_what_the_system_refuses_to_read_is_kept(comm, tmp_path, monkeypatch, name, rank):
    """It may be sound. All ranks raise, also if only the last one cannot read the file."""
    directory = fill(comm, tmp_path, [1])
    frames = write_frames(comm, directory.path)
    directory.write(2, arrays(comm, 2)[0], [frames.name])
    before = sorted(directory.path.iterdir())
    comm.Barrier()
    opened = damage._opened

    def refuse(path):
        if comm.rank == rank % comm.size and Path(path).name == name:
            raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))
        return opened(path)

    with monkeypatch.context() as patch:
        patch.setattr(damage, "_opened", refuse)
        with pytest.raises(ProductError, match=f"{name}: cannot be read: Too many open files; check"):
            directory.newest()
        if comm.rank == 0 == rank and name.startswith("step"):
            with pytest.raises(ProductError, match=f"{name}: cannot be read: Too many"):
                checkpoints_in(directory.path)
    comm.Barrier()
    assert sorted(directory.path.iterdir()) == before and directory.newest().content["step"] == 2


def write_frames(comm, directory):
    """A file that may belong to a checkpoint."""
    with create_product(comm, directory / "frames-00000000.h5", "frames", {}) as file:
        write_table(file, "table", {"values": np.arange(5000.0)})
    return directory / "frames-00000000.h5"


def harm(path, kind, chooser):
    """Flip a random bit of the values in a file, or cut it off."""
    content, name = bytearray(path.read_bytes()), "modes" if path.name.startswith("step") else "table/values"
    at = chooser.randrange(len(content))
    if kind == "flip":
        with h5py.File(path, locking=False) as file:
            chunk = file[name].id.get_chunk_info(0)
        at = chunk.byte_offset + at % chunk.size
        content[at] ^= 1 << chooser.randrange(8)
    else:
        del content[at:]
    path.write_bytes(content)
    return f"{kind} at {at} of {path}"


@pytest.mark.mpi(2)
def test_damage_is_found_and_the_checkpoint_before_is_used(comm, tmp_path, caplog):
    """Also damage of the frames that belong to it, and sound frames of another run."""
    path, chooser = tmp_path / "checkpoints", random.Random(comm.size)
    if comm.rank == 0:
        path.mkdir()
    frames = write_frames(comm, path)
    fill(comm, tmp_path, [1])
    CheckpointDirectory(comm, path, "settings").write(2, arrays(comm, 2)[0], [frames.name])
    assert CheckpointDirectory(comm, path, "settings").newest().files == [frames.name]
    for kind, name in 8 * [("flip", "step-00000002.h5"), ("cut", "step-00000002.h5")] + [
            ("flip", frames.name), ("cut", frames.name), ("others", frames.name)]:
        directory = CheckpointDirectory(comm, tmp_path / "trial", "settings")
        directory.remove()
        caplog.clear()
        harmed = f"{kind} {name}"
        if comm.rank == 0:
            shutil.copytree(path, directory.path)
            if kind != "others":
                harmed = harm(directory.path / name, kind, chooser)
        comm.Barrier()
        if kind == "others":
            write_frames(comm, directory.path)
        assert directory.newest().content["step"] == 1, harmed
        assert comm.rank > 0 or re.search(f"{name}: .*not used", caplog.text), harmed


@pytest.mark.mpi(2)
def test_a_full_disk_keeps_the_earlier_checkpoints(comm, tmp_path):
    """The last rank meets the limit."""
    directory = fill(comm, tmp_path, [1])
    for kilobytes in (1, 1100):  # at the beginning, and in the arrays
        with largest_file(comm, kilobytes * 1024, comm.size - 1), pytest.raises(WriteError, match="wanted.*intact"):
            directory.write(2, {**arrays(comm, 2)[0], "much": np.zeros(65000)})
        assert [path.name for path in directory.path.iterdir()] == ["step-00000001.h5"]
        assert directory.newest().content["step"] == 1
    directory.write(2, arrays(comm, 2)[0])
    assert directory.newest().content["step"] == 2


@pytest.mark.mpi(2, timeout=30)
@pytest.mark.parametrize("act", [CheckpointDirectory.remove, CheckpointDirectory.newest,
                                 lambda directory: directory.write(4, {"time": 1.0})],
                         ids=["remove", "clean", "keep the newest"])
def test_all_ranks_raise_if_a_file_cannot_be_removed(comm, tmp_path, monkeypatch, act):
    def refuse(path, **_):
        raise PermissionError(13, "Permission denied", str(path))

    directory = fill(comm, tmp_path, [1, 2, 3])
    first_rank(comm, (directory.path / "step-00000009.h5.partial").write_bytes, b"half")
    monkeypatch.setattr(shutil, "rmtree", refuse)
    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(WriteError, match="checkpoints.*: Permission denied"):
        act(directory)


WRITER = """
import sys
from pathlib import Path
import numpy as np
from mpi4py import MPI
from eddies.io.checkpoint import CheckpointDirectory
directory = CheckpointDirectory(MPI.COMM_SELF, Path(sys.argv[1]), "settings")
saved = directory.newest()
first = saved.content["step"] + 1 if saved else 1
for step in range(first, first + 10**6):
    directory.write(step, {"step": step, "numbers": np.full(20000, float(step))})
    print(step, flush=True)
"""


@pytest.mark.mpi(1)
def test_a_kill_leaves_a_checkpoint(comm, tmp_path):
    # The writer is a job of its own, not another rank of this one.
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("OMPI_", "PMIX_"))}
    chooser = random.Random(3)
    for _ in range(2):
        writer = subprocess.Popen([sys.executable, "-c", WRITER, tmp_path / "checkpoints"], stdout=subprocess.PIPE,
                                  text=True, env=environment)
        steps = [int(writer.stdout.readline()) for _ in range(4)]
        time.sleep(chooser.random() / 20)
        writer.kill()
        steps += [int(line) for line in writer.communicate()[0].split()]
        saved = CheckpointDirectory(comm, tmp_path / "checkpoints", "settings").newest()
        # The last one that was printed, or one that got its name and could not be printed any more.
        assert saved.content["step"] in (steps[-1], steps[-1] + 1)
        assert np.all(saved.read("numbers") == saved.content["step"])


@pytest.mark.mpi(2)
def test_the_guard_writes_checkpoints_when_due_and_before_a_stop(comm, tmp_path):
    stop = StopRequest(comm, checkpoint_seconds=1e9)
    guard = Guard(comm, tmp_path / "checkpoints", "settings", stop, " of the test")
    run = SimpleNamespace(steps=3, state_dict=lambda: {"steps": run.steps})
    guard(run)
    assert guard.checkpoints.newest() is None
    stop._checkpoint_at = 0.0
    guard(run)
    assert guard.checkpoints.newest()["steps"] == 3
    run.steps = 4
    guard(run)  # none is due so soon
    assert guard.checkpoints.newest()["steps"] == 3
    stop.signals = [10]
    with pytest.raises(Stopped, match="SIGUSR1.*from step 4 of the test"):
        guard(run)
    assert guard.checkpoints.newest()["steps"] == 4
