"""Cores and threads of a process: program and launcher read OMP_NUM_THREADS alike."""

import os

import pytest

from eddies import cores
from mpi_tools import launch
from tests.commands import LAUNCHER, python


@pytest.mark.parametrize("given, threads", [
    (None, 1), (" ", 1), ("3", 3), (" 4 ,2", 4), ("02", 2)])
def test_threads_are_those_of_openmp(monkeypatch, given, threads):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if given is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", given)
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    monkeypatch.setattr(launch, "local_cores", lambda: 8)
    monkeypatch.delenv("EDDIES_RANKS", raising=False)
    assert cores.threads() == threads and launch.default_ranks() == 8 // threads
    started = launch.mpi_environment(1)["OMP_NUM_THREADS"]
    cores.default_to_one_thread()
    assert os.environ["OMP_NUM_THREADS"] == started and started.strip()


def test_what_is_no_number_of_threads_is_refused(monkeypatch):
    for given in ("auto", "0", "-1", "2.5", "2,", "2,x", "2,0", "\u0662", "\u00b2", "1e3", "2;1", "1_0"):
        monkeypatch.setenv("OMP_NUM_THREADS", given)
        for reader in (cores.threads, launch.default_ranks):
            with pytest.raises(cores.ThreadsError, match=f'OMP_NUM_THREADS = "{given}": must be'):
                reader()


@pytest.mark.mpi(1)
def test_more_threads_than_processors_are_refused(comm, monkeypatch, capfd):
    from eddies.cli import main
    monkeypatch.setenv("OMP_NUM_THREADS", "1000")
    assert main(["scenes"]) == 2
    errors = capfd.readouterr().err
    assert "OMP_NUM_THREADS = 1000: " in errors and f"set it to {os.cpu_count()} or less\n" in errors
    with pytest.raises(cores.ThreadsError):
        launch.default_ranks()


def test_container_quota_limits_the_cores(monkeypatch, tmp_path):
    monkeypatch.setattr(cores, "CPU_QUOTA", tmp_path / "cpu.max")
    monkeypatch.setattr(cores, "processors", lambda: set(range(1000, 1008)))
    for quota, number in {"max 100000": 8, "250000 100000": 3, "50000 100000": 1}.items():
        cores.CPU_QUOTA.write_text(quota)
        assert cores.local_cores() == number


def test_the_launcher_needs_no_package():
    """It starts what sets up the packages."""
    ended = python("-S", "-E", LAUNCHER, "-n", "0", "--", "true")
    assert ended.returncode == 2 and '-n = "0": must be a whole number of at least 1' in ended.stderr
