"""One job at a time in a run directory, beside jobs that are alive, dead, or on another host."""

import errno
import fcntl
import os
import signal
import socket
import subprocess
import sys

import pytest

from eddies.io.errors import WriteError
from eddies.io.run_lock import RunInUse, job_in, lock_directory

HOST = socket.gethostname()


@pytest.mark.mpi(1, 2)
def test_a_job_holds_its_directory_and_leaves_nothing(comm, tmp_path):
    run = tmp_path / "a/run"
    with lock_directory(comm, run):
        comm.Barrier()
        line = (run / "LOCK").read_text()
        assert line.startswith(f"{HOST}, process ") and job_in(run) == f"in use by {line}"
        with pytest.raises(RunInUse, match=rf"run: another job works here \({line}\); .* MPI does not connect"):
            with lock_directory(comm, run):
                pass
        comm.Barrier()
        assert (run / "LOCK").read_text() == line
        comm.Barrier()
    comm.Barrier()
    assert list(run.iterdir()) == [] and job_in(run) == ""


@pytest.mark.mpi(1)
@pytest.mark.parametrize("line", ["node7, process 4242", f"{HOST}7, process 1", "another program's\nlines", ""])
def test_the_line_of_another_host_refuses_until_it_is_removed(comm, tmp_path, line):
    """Also in the directories of variants. An empty file, of a job that was killed before it wrote its line, does not.
    """
    run = tmp_path / "my run"
    (run / "a").mkdir(parents=True)
    (run / "b").mkdir()
    for path, words in ((run, line), (run / "a", line), (run / "b", "node8, process 9")):
        (path / "LOCK").write_text(words)
    if line:
        with pytest.raises(RunInUse, match="was killed") as refused, lock_directory(comm, run):
            pass
        assert (run / "LOCK").read_text() == line and job_in(run) == f"may be in use by {' '.join(line.split())}"
        command = str(refused.value).split("`")[1]
        assert command == f"rm '{run}/LOCK' '{run}/a/LOCK'"
        subprocess.run(command, shell=True, check=True)
    with lock_directory(comm, run):
        assert (run / "b/LOCK").exists()


@pytest.mark.mpi(1)
def test_a_batch_job_that_was_queued_again_goes_on_on_another_host(comm, tmp_path, monkeypatch):
    monkeypatch.delenv("SLURM_RESTART_COUNT", raising=False)
    for job, restarts, free in (("17", None, False), ("17", "0", False), ("18", "1", False), ("17", "1", True)):
        (tmp_path / "LOCK").write_text("node7, process 4242, Slurm job 17, restart 0")
        monkeypatch.setenv("SLURM_JOB_ID", job)
        if restarts is not None:
            monkeypatch.setenv("SLURM_RESTART_COUNT", restarts)
        if free:
            with lock_directory(comm, tmp_path):
                assert job_in(tmp_path).endswith("Slurm job 17, restart 1")
        else:
            with pytest.raises(RunInUse, match="was killed"), lock_directory(comm, tmp_path):
                pass


@pytest.mark.mpi(1)
@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EIO])
def test_a_file_system_without_locks_gives_a_warning(comm, tmp_path, monkeypatch, caplog, number):
    """Any line counts there, also that of a job on this host, which may be alive. Other errors of a file system are
    told."""
    def flock(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", flock)
    if number == errno.EIO:
        with pytest.raises(WriteError, match="Input/output error"), lock_directory(comm, tmp_path):
            pass
        return
    with lock_directory(comm, tmp_path):
        assert "this file system has no locks" in caplog.text and job_in(tmp_path).startswith("may be in use by")
        with pytest.raises(RunInUse, match="was killed"), lock_directory(comm, tmp_path):
            pass
    assert not list(tmp_path.iterdir())


@pytest.mark.mpi(1)
def test_a_lock_that_another_job_has_just_removed_does_not_count(comm, tmp_path, monkeypatch):
    flock, calls = fcntl.flock, []

    def late(file, kind):
        if not calls:
            (tmp_path / "LOCK").unlink()
        calls.append(kind)
        flock(file, kind)

    monkeypatch.setattr(fcntl, "flock", late)
    with lock_directory(comm, tmp_path):
        assert len(calls) == 2 and f"process {os.getpid()}" in (tmp_path / "LOCK").read_text()


@pytest.mark.mpi(1)
def test_the_lock_of_the_next_job_is_not_removed(comm, tmp_path):
    """The user has removed the file, and another job has begun."""
    with lock_directory(comm, tmp_path):
        (tmp_path / "LOCK").unlink()
        (tmp_path / "LOCK").write_text("another")
    assert (tmp_path / "LOCK").read_text() == "another"


JOB = """
import sys
from pathlib import Path
from mpi4py import MPI
from eddies.io.run_lock import RunInUse, lock_directory
for place in sys.stdin:
    try:
        with lock_directory(MPI.COMM_SELF, Path(place.strip())):
            print("in", flush=True)
            input()
    except RunInUse:
        print("out", flush=True)
        input()
"""


@pytest.fixture
def jobs():
    """Two processes. Each takes the lock of the directory that it reads from a line, and frees it at the next line."""
    started = [subprocess.Popen([sys.executable, "-c", JOB], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
               for _ in range(2)]
    try:
        yield started
    finally:
        for job in started:
            with job:
                job.kill()


def tell(job, line):
    job.stdin.write(f"{line}\n")
    job.stdin.flush()


def test_of_jobs_that_start_together_one_gets_in(jobs, tmp_path):
    """Without a lock, and with that of a job of this host that was killed."""
    for trial in range(12):
        run = tmp_path / f"{trial}"
        if trial % 2:
            run.mkdir()
            (run / "LOCK").write_text(f"{HOST}, process 1")
        for job in jobs:
            tell(job, run)
        assert sorted(job.stdout.readline() for job in jobs) == ["in\n", "out\n"]
        for job in jobs:
            tell(job, "")
    for job in jobs:
        job.stdin.close()
    assert [job.wait(20) for job in jobs] == [0, 0] and not list(tmp_path.glob("*/LOCK"))


def test_a_killed_job_frees_the_directory_on_its_host(jobs, tmp_path):
    first, second = jobs
    tell(first, tmp_path)
    assert first.stdout.readline() == "in\n" and f"process {first.pid}" in job_in(tmp_path)
    first.send_signal(signal.SIGKILL)
    first.wait()
    assert (tmp_path / "LOCK").exists() and job_in(tmp_path) == ""
    tell(second, tmp_path)
    assert second.stdout.readline() == "in\n" and f"process {second.pid}" in (tmp_path / "LOCK").read_text()
