"""Checkpoints are whole and undamaged, or are not used."""

import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from eddies.io.checkpoint import CheckpointDirectory
from eddies.io.contiguous import Block
from eddies.io.hdf5 import ProductError
from eddies.io.verification import add_checksums
from eddies.parallel.slab import block_starts

SHAPE = (3, 5, 7, 4)  # seven rows along the axis that is cut


def arrays(comm, step):
    """A state, rows of particles, and a table that all ranks hold."""
    generator = np.random.default_rng(step)
    modes = generator.standard_normal(SHAPE) + 1j * generator.standard_normal(SHAPE)
    rows, table = generator.standard_normal((10, 3)), generator.standard_normal(6)
    cuts = [block_starts(total, comm.size)[comm.rank : comm.rank + 2] for total in (7, 10)]
    return {"modes": Block(modes[:, :, slice(*cuts[0])], int(cuts[0][0]), 7, axis=2),
            "position": Block(rows[slice(*cuts[1])], int(cuts[1][0]), 10), "table": table,
            "nothing": np.zeros((0, 2))}, modes, rows


def fill(comm, path, steps, fingerprint="settings"):
    directory = CheckpointDirectory(comm, path / "checkpoints", fingerprint)
    for step in steps:
        directory.write(step, {"time": step / 3, "end": np.inf, **arrays(comm, step)[0]})
    return directory


@pytest.mark.mpi(1, 2, 3)
def test_what_is_read_is_what_was_written(comm, tmp_path):
    saved = fill(comm, tmp_path, [200]).newest()
    _, modes, rows = arrays(comm, 200)
    assert (saved["time"], saved["end"]) == (200 / 3, np.inf) and saved.files == []
    assert set(saved) == {"time", "end", "modes", "position", "table", "nothing"} and len(saved) == 6
    assert np.array_equal(saved["table"], arrays(comm, 200)[0]["table"])
    assert np.array_equal(saved.read("modes"), modes) and saved.read("modes").dtype == np.complex128
    assert np.array_equal(saved.read("modes", 2, 5, axis=2), modes[:, :, 2:5])
    assert np.array_equal(saved.read("position", 3, 4), rows[3:4])
    assert saved.read("nothing").shape == (0, 2)


@pytest.mark.mpi(1, 2)
def test_the_newest_three_are_kept(comm, tmp_path):
    directory = fill(comm, tmp_path, [1, 2, 3, 10, 11])
    comm.Barrier()
    assert sorted(path.name for path in directory.path.iterdir()) == [f"step-{n:08d}" for n in (3, 10, 11)]
    assert directory.newest().content["step"] == 11
    directory.remove()
    assert not directory.path.exists()


@pytest.mark.mpi(1, 2)
def test_other_kernels_and_threads_than_those_that_made_it_are_told(comm, tmp_path, caplog, monkeypatch):
    directory = fill(comm, tmp_path, [1])
    comm.Barrier()
    assert directory.newest() is not None and "bit for bit" not in caplog.text
    monkeypatch.setattr("eddies.io.checkpoint.in_use", lambda: "another")
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    assert directory.newest().content["step"] == 1
    assert comm.rank > 0 or ("now there are compiled kernels: another, threads a rank: 7: the run goes on, but not "
                             "bit for bit") in caplog.text


@pytest.mark.mpi(1, 2)
def test_leftovers_are_removed_and_other_settings_not_used(comm, tmp_path, caplog):
    directory = fill(comm, tmp_path, [1])
    comm.Barrier()
    if comm.rank == 0:
        (directory.path / "step-00000002.partial").mkdir()
        (directory.path / "frames-00000001.h5").write_bytes(b"later than the checkpoint")
    comm.Barrier()
    assert directory.newest().content["step"] == 1
    assert [path.name for path in directory.path.iterdir()] == ["step-00000001"]
    comm.Barrier()
    assert CheckpointDirectory(comm, directory.path, "others").newest() is None
    assert comm.rank > 0 or "step-00000001: was made with other settings" in caplog.text
    assert list(directory.path.iterdir()) == []


@pytest.mark.mpi(1, 2)
def test_a_checkpoint_of_another_version_is_not_used(comm, tmp_path, caplog, monkeypatch):
    monkeypatch.setattr("eddies.io.checkpoint.FORMAT", 1)
    directory = fill(comm, tmp_path, [1])
    monkeypatch.undo()
    assert directory.newest() is None
    assert comm.rank > 0 or "step-00000001: was made by another version of eddies; this" in caplog.text


def harm(path, kind, chooser):
    """Flip a random bit of a file or cut it off; what was harmed, in words."""
    content = bytearray(path.read_bytes())
    at = chooser.randrange(len(content))
    if kind == "flip":
        content[at] ^= 1 << chooser.randrange(8)
    else:
        del content[at:]
    path.write_bytes(content)
    return f"{kind} at {at} of {path}"


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("kind", ["flip", "truncation"])
def test_damage_is_found_and_the_checkpoint_before_is_used(comm, tmp_path, caplog, kind):
    whole, chooser = fill(comm, tmp_path, [1, 2]).path, random.Random(comm.size)
    names = ("state.h5", "manifest.json")
    for trial in range(50):
        directory = CheckpointDirectory(comm, tmp_path / "trial", "settings")
        directory.remove()
        caplog.clear()
        if comm.rank == 0:
            shutil.copytree(whole, directory.path)
            name = chooser.choices(names, [3, 1])[0]
            harmed = harm(directory.path / "step-00000002" / name, kind, chooser)
        comm.Barrier()
        assert directory.newest().content["step"] == 1, trial
        if comm.rank == 0:
            assert f"step-00000002/{name}: " in caplog.text and "not used" in caplog.text, harmed
            named = "was cut off" if kind == "truncation" else "is not what was written|checksums are missing"
            assert name != "state.h5" or re.search(f"state.h5: .*({named})", caplog.text), harmed


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("kind, told", [("flip", "is not what was written"), ("truncation", "was cut off"),
                                        ("others", "is another file than was written")])
def test_damage_of_frames_is_found(comm, tmp_path, caplog, kind, told):
    directory = CheckpointDirectory(comm, tmp_path / "checkpoints", "settings")
    directory.write(1, arrays(comm, 1)[0])
    frames = directory.path / "frames-00000001.h5"
    if comm.rank == 0:
        frames.write_bytes(b"frames" * 1000)
    add_checksums(comm, frames)
    directory.write(2, arrays(comm, 2)[0], [frames.name])
    assert directory.newest().files == [frames.name]
    comm.Barrier()
    if comm.rank == 0:
        if kind == "others":
            frames.write_bytes(b"others" * 1000)
        else:
            harm(frames, kind, random.Random(1))
    if kind == "others":
        add_checksums(comm, frames)
    comm.Barrier()
    assert directory.newest().content["step"] == 1
    assert comm.rank > 0 or re.search(f"frames-00000001.h5: .*{told}.*; this checkpoint is not used", caplog.text)


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("kilobytes", [1, 5, 8])
def test_a_full_disk_is_told_and_harms_nothing(comm, tmp_path, kilobytes):
    directory = fill(comm, tmp_path, [1])
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    # The last rank meets the end of the disk.
    if comm.rank == comm.size - 1:
        resource.setrlimit(resource.RLIMIT_FSIZE, (kilobytes * 1024, limits[1]))
    try:
        with pytest.raises(ProductError, match="step-00000002: cannot be written .*intact: once there is room"):
            directory.write(2, arrays(comm, 2)[0])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
    comm.Barrier()
    assert [path.name for path in directory.path.iterdir()] == ["step-00000001"]
    assert directory.newest().content["step"] == 1
    directory.write(2, arrays(comm, 2)[0])
    assert directory.newest().content["step"] == 2


def refuse(path, *_, ignore_errors=False, **__):
    """In place of shutil.rmtree, of which the message of an error is the same."""
    if not ignore_errors:
        raise PermissionError(13, "Permission denied", str(path))


@pytest.mark.mpi(1, 2, timeout=30)
@pytest.mark.parametrize("act", [CheckpointDirectory.remove, CheckpointDirectory.newest,
                                 lambda directory: directory.write(4, {"time": 1.0})],
                         ids=["remove", "clean", "keep the newest"])
def test_what_cannot_be_removed_is_told_by_all(comm, tmp_path, monkeypatch, act):
    directory = fill(comm, tmp_path, [1, 2, 3])
    comm.Barrier()
    if comm.rank == 0:
        (directory.path / "step-00000009.partial").mkdir()
    comm.Barrier()
    monkeypatch.setattr(shutil, "rmtree", refuse)
    with pytest.raises(ProductError, match="checkpoints.*: Permission denied; check the file, its directory"):
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
    for _ in range(5):
        writer = subprocess.Popen([sys.executable, "-c", WRITER, tmp_path / "checkpoints"], stdout=subprocess.PIPE,
                                  text=True, env=environment)
        told = [int(writer.stdout.readline()) for _ in range(4)]
        time.sleep(chooser.random() / 20)
        writer.kill()
        told += [int(line) for line in writer.communicate()[0].split()]
        saved = CheckpointDirectory(comm, tmp_path / "checkpoints", "settings").newest()
        # The one that was told last, or one that got its name and was not told any more.
        assert saved.content["step"] in (told[-1], told[-1] + 1)
        assert np.all(saved.read("numbers") == saved.content["step"])
