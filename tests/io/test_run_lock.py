"""One job at a time in a run directory, by processes that are alive, dead, or silent."""

import json
import os
import re
import subprocess
import sys
import time
from dataclasses import replace

import pytest

from eddies.io import run_lock
from eddies.io.hdf5 import create_product
from eddies.io.run_lock import Holder, RunInUse, RunLock, RunTakenOver, lock_directory, refuse_if_held
from eddies.io.unfinished import Unfinished
from eddies.parallel.stop import StopRequest


def put(directory, holder, silent=0.0):
    """The lock of somebody else, with a last sign of life so many seconds ago."""
    directory.mkdir(exist_ok=True)
    path = directory / "LOCK"
    path.write_text(json.dumps(vars(holder)))
    os.utime(path, (time.time() - silent,) * 2)


@pytest.fixture
def elsewhere():
    """A job on another machine, of which nothing is known here but its signs of life."""
    return Holder("another", "node7", "another boot", 4242, "17", "", 0, "2026-01-01T00:00:00+00:00")


@pytest.mark.mpi(1, 2)
def test_a_job_holds_its_directory_and_leaves_nothing(comm, tmp_path):
    with lock_directory(comm, tmp_path / "a/run") as loss:
        comm.Barrier()
        known = json.loads((tmp_path / "a/run/LOCK").read_text())
        assert known["host"] and known["start"] and loss() is None
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
@pytest.mark.parametrize("silent, free", [(0, False), (290, False), (310, True), (-3600, False)])
def test_a_job_elsewhere_is_believed_to_live_for_five_minutes(comm, tmp_path, elsewhere, silent, free):
    put(tmp_path, elsewhere, silent)
    if free:
        refuse_if_held(comm, tmp_path)
        with lock_directory(comm, tmp_path):
            assert json.loads((tmp_path / "LOCK").read_text())["pid"] == os.getpid()
    else:
        with pytest.raises(RunInUse, match="process 4242 on node7, since 2026-01-01"), lock_directory(comm, tmp_path):
            pass
        assert json.loads((tmp_path / "LOCK").read_text())["pid"] == 4242


@pytest.mark.mpi(1)
def test_the_clock_of_the_file_system_counts(comm, tmp_path, elsewhere, monkeypatch):
    put(tmp_path, elsewhere)
    ahead = time.time() + 400
    monkeypatch.setattr(time, "time", lambda: ahead)
    with pytest.raises(RunInUse):
        refuse_if_held(comm, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["LOCK"]


@pytest.mark.mpi(1)
def test_a_process_that_is_seen_alive_has_not_ended(comm, tmp_path):
    """However long ago its last sign of life was, as on a file system that does not take it."""
    put(tmp_path, replace(Holder.this_job(), job="another"), silent=3600.0)
    with pytest.raises(RunInUse, match="its last sign of life was 1 h 00 min ago"):
        refuse_if_held(comm, tmp_path)


@pytest.mark.mpi(1)
def test_a_job_of_this_machine_that_has_ended_holds_nothing(comm, tmp_path):
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    own = Holder.this_job()
    put(tmp_path, replace(own, job="another", pid=process.pid, born=run_lock._born(process.pid)))
    with pytest.raises(RunInUse):
        refuse_if_held(comm, tmp_path)
    process.kill()
    while not run_lock._born(process.pid) == "":
        time.sleep(0.01)
    refuse_if_held(comm, tmp_path)  # a zombie
    process.wait()
    refuse_if_held(comm, tmp_path)
    put(tmp_path, replace(own, job="another", born="1"))  # its number is another process's now
    refuse_if_held(comm, tmp_path)


@pytest.mark.mpi(1)
def test_a_lock_that_may_not_be_read_holds(comm, tmp_path):
    (tmp_path / "LOCK").mkdir()
    with pytest.raises(RunInUse, match="an unknown machine"):
        refuse_if_held(comm, tmp_path)


@pytest.mark.mpi(1, timeout=30)
@pytest.mark.parametrize("change", [{"pid": "abc"}, {"pid": 0}, {"pid": -1}, {"pid": 10**30}, {"pid": None},
                                    {"restarts": "x"}, {"start": 3}, None], ids=repr)
def test_a_lock_of_other_types_is_none_of_a_job(comm, tmp_path, monkeypatch, change):
    """A lock of this machine and batch job, whose process and restarts the reader checks; or a pipe."""
    monkeypatch.setenv("SLURM_JOB_ID", "7")
    put(tmp_path, Holder.this_job())
    if change is None:
        (tmp_path / "LOCK").unlink()
        os.mkfifo(tmp_path / "LOCK")
    else:
        (tmp_path / "LOCK").write_text(json.dumps(vars(Holder.this_job()) | change))
    with pytest.raises(RunInUse, match="an unknown machine"):
        refuse_if_held(comm, tmp_path)
    with lock_directory(comm, tmp_path, take_over=True):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.mpi(1)
@pytest.mark.parametrize("content", ["", "[]", '{"job": 3}', "\xff"])
def test_a_lock_that_cannot_be_read_holds_as_long_as_it_is_new(comm, tmp_path, content):
    (tmp_path / "LOCK").write_text(content, encoding="latin-1")
    with pytest.raises(RunInUse, match="an unknown machine"):
        refuse_if_held(comm, tmp_path)
    with lock_directory(comm, tmp_path, take_over=True):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.mpi(1, 2)
def test_a_job_that_lost_its_directory_ends_and_touches_nothing(comm, tmp_path, monkeypatch):
    monkeypatch.setattr(run_lock, "LOOK_SECONDS", 0.0)
    stop = StopRequest(comm)
    product = tmp_path / "kernel.h5.partial"
    taken = rf"{re.escape(str(tmp_path))}: another job has taken this run directory over \(process"
    with pytest.raises(RunTakenOver, match=taken), lock_directory(comm, tmp_path) as loss, stop.watching(loss):
        assert not stop()
        with create_product(comm, tmp_path / "kernel.h5", "kernel", {}):
            with lock_directory(comm, tmp_path, take_over=True):
                if comm.rank == 0:
                    product.unlink()  # as a job does when it begins
                comm.Barrier()
                theirs = Unfinished(comm, product)
                stop()
    theirs.close()
    comm.Barrier()
    assert [path.name for path in tmp_path.iterdir()] == ["kernel.h5.partial"]


@pytest.mark.mpi(1)
def test_a_job_that_slept_while_another_came_and_went_has_lost_its_directory(comm, tmp_path, monkeypatch):
    monkeypatch.setattr(run_lock, "LOOK_SECONDS", 0.0)
    with lock_directory(comm, tmp_path) as loss:
        with lock_directory(comm, tmp_path, take_over=True):
            pass
        assert "taken this run directory over, and has ended; this" in str(loss())
        with pytest.raises(RunTakenOver, match="kernel.h5: another job has taken"):
            with create_product(comm, tmp_path / "kernel.h5", "kernel", {}):
                (tmp_path / "kernel.h5.partial").unlink()  # as the other has
    assert not list(tmp_path.iterdir())


@pytest.mark.mpi(1)
def test_a_file_system_that_does_not_answer_is_no_loss(comm, tmp_path, monkeypatch):
    monkeypatch.setattr(run_lock, "LOOK_SECONDS", 0.0)
    with lock_directory(comm, tmp_path) as loss:
        def fail(directory):
            raise OSError(116, "Stale file handle")

        with monkeypatch.context() as patched:
            patched.setattr(run_lock, "find_lock", fail)
            assert loss() is None


@pytest.mark.mpi(1)
def test_a_batch_job_that_was_queued_again_knows_that_it_has_ended(comm, tmp_path, elsewhere, monkeypatch):
    put(tmp_path, replace(elsewhere, batch="17"))
    for job, restarts, free in (("18", "1", False), ("17", "0", False), ("17", "1", True)):
        with monkeypatch.context() as patched:
            patched.setenv("SLURM_JOB_ID", job)
            patched.setenv("SLURM_RESTART_COUNT", restarts)
            if not free:
                with pytest.raises(RunInUse):
                    refuse_if_held(comm, tmp_path)
            else:
                refuse_if_held(comm, tmp_path)


@pytest.mark.mpi(1)
def test_a_process_of_another_user_is_alive_though_nothing_is_told_of_it(comm, tmp_path, monkeypatch):
    put(tmp_path, replace(Holder.this_job(), job="another", pid=4242, born="17"))

    def refuse(pid, number):
        raise PermissionError

    monkeypatch.setattr(os, "kill", refuse)
    with pytest.raises(RunInUse):
        refuse_if_held(comm, tmp_path)


@pytest.mark.mpi(1)
def test_signs_of_life(comm, tmp_path, monkeypatch, elsewhere):
    monkeypatch.setattr(run_lock, "SIGN_SECONDS", 0.01)
    path = tmp_path / "LOCK"

    def wait(condition):
        end = time.monotonic() + 20
        while not condition():
            assert time.monotonic() < end
            time.sleep(0.005)

    with lock_directory(comm, tmp_path):
        os.utime(path, (0, 0))
        wait(lambda: path.stat().st_mtime > time.time() - 20)
        path.unlink()
        wait(path.exists)
        put(tmp_path, elsewhere, silent=1000)
        time.sleep(0.1)  # for a sign that was under way
        put(tmp_path, elsewhere, silent=1000)
        time.sleep(0.1)
        assert path.stat().st_mtime < time.time() - 900  # no sign for another
    assert json.loads(path.read_text())["job"] == "another"


@pytest.mark.mpi(1)
def test_of_two_that_find_a_dead_job_one_gets_in(comm, tmp_path, elsewhere, monkeypatch):
    """The second judges what it found before the first has replaced it."""
    put(tmp_path, elsewhere, silent=1000)
    found = run_lock.find_lock(tmp_path)
    first = run_lock._take(tmp_path, False)
    answers = iter([found])
    monkeypatch.setattr(run_lock, "find_lock", lambda directory, real=run_lock.find_lock: next(answers, None) or real(
        directory))
    with pytest.raises(RunInUse, match=f"process {os.getpid()} on"):
        run_lock._take(tmp_path, False)
    assert json.loads((tmp_path / "LOCK").read_text())["job"] == first.holder.job
    first.release()
    assert not list(tmp_path.iterdir())


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
    """Twenty times, without a lock and with that of a job that was killed."""
    places = [tmp_path / f"{trial:02d}" for trial in range(20)]
    for trial, place in enumerate(places):
        place.mkdir()
        if trial % 2:
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
    assert {path.name for path in tmp_path.rglob("*") if path.is_file()} == {"go", "LOCK.dead"}


@pytest.mark.mpi(1, 2)
def test_a_directory_that_cannot_be_made(comm, tmp_path):
    if comm.rank == 0:
        (tmp_path / "file").write_text("")
    comm.Barrier()
    with pytest.raises(run_lock.UserError, match="choose another --output"), lock_directory(comm, tmp_path / "file/a"):
        pass


def test_a_lock_goes_with_its_job_by_itself(tmp_path):
    lock = RunLock(tmp_path, Holder.this_job())
    run_lock._write(lock.path, lock.holder)
    lock.release()
    assert not lock.path.exists()
