"""One job at a time in a run directory, beside jobs that are alive, dead, or silent."""

import json
import os
import subprocess
import sys
import time
from dataclasses import replace

import pytest

from eddies.io import run_lock
from eddies.io.errors import WriteError
from eddies.io.hdf5 import create_product
from eddies.io.run_lock import Holder, RunInUse, RunTakenOver, lock_directory, refuse_if_held
from eddies.parallel.stop import StopRequest


def put(directory, holder, silent=0.0):
    """Write the lock of another job, with its last sign of life so many seconds ago."""
    directory.mkdir(exist_ok=True)
    path = directory / "LOCK"
    path.write_text(json.dumps(vars(holder)))
    os.utime(path, (time.time() - silent,) * 2)


def failing(error):
    """A function that raises an error."""
    def fail(*_):
        raise error

    return fail


@pytest.fixture
def elsewhere():
    """A job on another machine, of which this one knows only the signs of life."""
    return Holder("another", "node7", "another boot", 4242, "17", "", 0, "2026-01-01T00:00:00+00:00")


@pytest.fixture
def quick(monkeypatch):
    """A lost directory is noticed at once, and a lock replaced without a pause."""
    monkeypatch.setattr(run_lock, "LOOK_SECONDS", 0.0)
    monkeypatch.setattr(run_lock, "SETTLE_SECONDS", 0.0)


@pytest.mark.mpi(1, 2)
def test_a_job_holds_its_directory_and_leaves_nothing(comm, tmp_path):
    with lock_directory(comm, tmp_path / "a/run") as lock_lost:
        comm.Barrier()
        known = json.loads((tmp_path / "a/run/LOCK").read_text())
        assert known["host"] and known["start"] and lock_lost() is None
        with pytest.raises(RunInUse, match=rf"run: another job works here \(process {known['pid']} on .*--take-over"):
            refuse_if_held(comm, tmp_path / "a/run")
        with pytest.raises(RunInUse), lock_directory(comm, tmp_path / "a/run"):
            pass
        comm.Barrier()
        assert json.loads((tmp_path / "a/run/LOCK").read_text()) == known
        comm.Barrier()
    comm.Barrier()
    assert list((tmp_path / "a").iterdir()) == []
    refuse_if_held(comm, tmp_path / "a/run")


@pytest.mark.mpi(1)
@pytest.mark.usefixtures("quick")
def test_a_job_elsewhere_counts_for_five_minutes_after_its_last_sign(comm, tmp_path, elsewhere, monkeypatch):
    """The clock of the file system counts, also if the clock of the machine is ahead."""
    clock = time.time
    for silent, ahead in ((0, 0), (290, 0), (-3600, 0), (0, 400)):
        put(tmp_path, elsewhere, silent)
        with monkeypatch.context() as patch:
            patch.setattr(time, "time", lambda: clock() + ahead)
            with pytest.raises(RunInUse, match="process 4242 on node7"), lock_directory(comm, tmp_path):
                pass
        assert json.loads((tmp_path / "LOCK").read_text())["pid"] == 4242
    put(tmp_path, elsewhere, 310)
    with lock_directory(comm, tmp_path):
        assert json.loads((tmp_path / "LOCK").read_text())["pid"] == os.getpid()


@pytest.mark.mpi(1)
def test_a_machine_knows_which_of_its_processes_live(comm, tmp_path, monkeypatch):
    """A living process holds the lock without recent signs of life. Its number may belong to another process later."""
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    job = replace(Holder.this_job(), job="another", pid=process.pid, born=run_lock._born(process.pid))
    put(tmp_path, job, silent=3600)
    with pytest.raises(RunInUse, match="1 h 00 min ago"):
        refuse_if_held(comm, tmp_path)
    put(tmp_path, replace(job, born="1"))
    refuse_if_held(comm, tmp_path)
    for hidden in (False, True):  # a process of another user, which /proc may hide
        with monkeypatch.context() as patch:
            patch.setattr(os, "kill", failing(PermissionError))
            if hidden:
                patch.setattr(run_lock, "_born", lambda _: "")
            put(tmp_path, job, silent=3600)
            with pytest.raises(RunInUse):
                refuse_if_held(comm, tmp_path)
    put(tmp_path, replace(job, born=""))  # unknown, so that the signs of life count
    with pytest.raises(RunInUse):
        refuse_if_held(comm, tmp_path)
    put(tmp_path, job)
    process.kill()
    while run_lock._born(process.pid):
        time.sleep(0.01)
    refuse_if_held(comm, tmp_path)  # a zombie
    process.wait()
    refuse_if_held(comm, tmp_path)


@pytest.mark.mpi(1)
def test_a_batch_job_that_was_queued_again_knows_that_it_had_ended(comm, tmp_path, elsewhere, monkeypatch):
    put(tmp_path, replace(elsewhere, batch="17"))
    for job, restarts, free in (("18", "1", False), ("17", "0", False), ("17", "1", True)):
        monkeypatch.setenv("SLURM_JOB_ID", job)
        monkeypatch.setenv("SLURM_RESTART_COUNT", restarts)
        if free:
            refuse_if_held(comm, tmp_path)
        else:
            with pytest.raises(RunInUse):
                refuse_if_held(comm, tmp_path)


@pytest.mark.mpi(1)
@pytest.mark.usefixtures("quick")
def test_an_unreadable_lock_holds_while_it_is_new(comm, tmp_path):
    """Empty, of another program, cut off, of another version."""
    for content in ("", "[]", '{"job": 3}', "\xff", json.dumps(vars(Holder.this_job()))[:-9]):
        (tmp_path / "LOCK").write_text(content, encoding="latin-1")
        with pytest.raises(RunInUse, match="an unknown machine"):
            refuse_if_held(comm, tmp_path)
        with lock_directory(comm, tmp_path, take_over=True):
            pass
        assert not list(tmp_path.iterdir())


@pytest.mark.mpi(1, 2)
@pytest.mark.usefixtures("quick")
def test_a_job_that_lost_its_directory_ends_and_touches_nothing(comm, tmp_path):
    stop, partial = StopRequest(comm), tmp_path / "kernel.h5.partial"
    with pytest.raises(RunTakenOver, match=r"another job has taken over this run directory \(process"):
        with lock_directory(comm, tmp_path) as lock_lost, stop.watching(lock_lost):
            assert not stop()
            with create_product(comm, tmp_path / "kernel.h5", "kernel", {}):
                with lock_directory(comm, tmp_path, take_over=True):
                    if comm.rank == 0:  # as the other job does when it begins the product
                        partial.unlink()
                        partial.write_text("theirs")
                    comm.Barrier()
                    stop()
    comm.Barrier()
    assert [path.name for path in tmp_path.iterdir()] == ["kernel.h5.partial"] and partial.read_text() == "theirs"


@pytest.mark.mpi(1)
@pytest.mark.usefixtures("quick")
def test_a_job_that_slept_while_another_came_and_went_has_lost_its_directory(comm, tmp_path, monkeypatch):
    with lock_directory(comm, tmp_path) as lock_lost:
        with monkeypatch.context() as patch:
            patch.setattr(run_lock, "find_lock", failing(OSError))
            assert lock_lost() is None  # a file system that hangs
        with lock_directory(comm, tmp_path, take_over=True):
            pass
        assert isinstance(lock_lost(), RunTakenOver)
        with pytest.raises(RunTakenOver, match="kernel.h5: another job has taken"):
            with create_product(comm, tmp_path / "kernel.h5", "kernel", {}):
                (tmp_path / "kernel.h5.partial").unlink()  # as the other job has
    assert not list(tmp_path.iterdir())


@pytest.mark.mpi(1)
@pytest.mark.usefixtures("quick")
def test_a_lock_that_cannot_be_replaced_leaves_nothing(comm, tmp_path, monkeypatch, elsewhere):
    put(tmp_path, elsewhere, silent=1000)
    monkeypatch.setattr(os, "replace", failing(PermissionError(13, "Permission denied")))
    with pytest.raises(WriteError, match="Permission denied"), lock_directory(comm, tmp_path):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["LOCK"]


@pytest.mark.mpi(1)
def test_signs_of_life(comm, tmp_path, monkeypatch, elsewhere):
    monkeypatch.setattr(run_lock, "SIGN_SECONDS", 0.01)
    path, end = tmp_path / "LOCK", time.monotonic() + 20
    with lock_directory(comm, tmp_path):
        os.utime(path, (0, 0))
        while path.stat().st_mtime < time.time() - 20:
            assert time.monotonic() < end
            time.sleep(0.005)
        put(tmp_path, elsewhere, silent=1000)
        time.sleep(0.1)  # a sign may be under way
        put(tmp_path, elsewhere, silent=1000)
        time.sleep(0.1)
        assert path.stat().st_mtime < time.time() - 900  # no sign for another job
    assert json.loads(path.read_text())["job"] == "another"


STARTS = """
import sys, time
from pathlib import Path
from mpi4py import MPI
from eddies.io.run_lock import RunInUse, lock_directory
print("ready", flush=True)
for place in sorted(Path(sys.argv[1]).iterdir()):
    while not (place / "go").exists():
        time.sleep(1e-4)
    try:
        with lock_directory(MPI.COMM_SELF, place / "run"):
            print("in", flush=True)
            input()
    except RunInUse:
        print("out", flush=True)
        input()
"""


def test_of_jobs_that_start_together_one_gets_in(tmp_path):
    """Without a lock, and with that of a job that was killed, which the last of them replaces."""
    places = [tmp_path / f"{trial:02d}" for trial in range(12)]
    for trial, place in enumerate(places):
        place.mkdir()
        if trial % 3 == 0:
            put(place / "run", Holder("dead", "node7", "", 1, "", "", 0, ""), silent=1000)
    jobs = [subprocess.Popen([sys.executable, "-c", STARTS, str(tmp_path)], stdin=subprocess.PIPE,
                             stdout=subprocess.PIPE, text=True) for _ in range(2)]
    for job in jobs:
        assert job.stdout.readline() == "ready\n"
    for place in places:
        (place / "go").write_text("")
        assert sorted(job.stdout.readline() for job in jobs) == ["in\n", "out\n"]
        for job in jobs:
            job.stdin.write("\n")
            job.stdin.flush()
    assert [job.wait(timeout=60) for job in jobs] == [0, 0]
    assert {path.name for path in tmp_path.rglob("*") if path.is_file()} == {"go"}
