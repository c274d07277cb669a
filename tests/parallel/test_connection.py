"""Ranks that MPI does not connect, by the variables that launchers set."""

import os

import pytest

import eddies
from eddies.parallel.connection import LAUNCHERS, SHELL, NotConnected, require_connected

MPIRUN, HYDRA, SLURM = LAUNCHERS


@pytest.fixture
def started(comm, monkeypatch):
    """Sets the variables of launchers: the number of ranks that each has started beyond those that MPI connects."""
    for name in (*LAUNCHERS, *LAUNCHERS.values(), SHELL):
        monkeypatch.delenv(name, raising=False)

    def set_numbers(**more):
        for name, number in more.items():
            monkeypatch.setenv(name, str(comm.size + number))
    return set_numbers


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("size, rank, remedy", [(MPIRUN, "0", "mpirun of "), (HYDRA, "1", "mpirun of "),
                                                (SLURM, None, "`srun --mpi=pmix`")])
def test_more_ranks_than_mpi_connects_are_refused(comm, started, monkeypatch, size, rank, remedy):
    started(**{size: 2})
    if rank is not None:
        monkeypatch.setenv(LAUNCHERS[size], rank)
    with pytest.raises(NotConnected) as refused:
        require_connected(comm)
    for words in (f"{comm.size + 2} ranks were started ({size})", f"connects {comm.size}", remedy, f"unset {size}"):
        assert words in str(refused.value)
    assert refused.value.first == (rank != "1")


@pytest.mark.mpi(1)
def test_ranks_of_slurm_get_the_remedy_of_slurm(comm, started):
    started(PMI_SIZE=1, SLURM_STEP_NUM_TASKS=1)  # srun --mpi=pmi2 sets both
    with pytest.raises(NotConnected, match="with `srun --mpi=pmix`"):
        require_connected(comm)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("more", [
    {}, {MPIRUN: 0}, {HYDRA: 0}, {SLURM: 0}, {HYDRA: -1},
    pytest.param({MPIRUN: 0, HYDRA: 1, SLURM: 1}, id="mpirun in a step of Slurm"),
    pytest.param({HYDRA: 0, SLURM: 1}, id="mpiexec in a step of Slurm"),
    pytest.param({HYDRA: 1, SLURM: 1, SHELL: 30000}, id="by hand in a shell of srun --pty")])
def test_ranks_that_mpi_connects_pass(comm, started, monkeypatch, more):
    """A variable without a number counts for nothing."""
    monkeypatch.setenv(HYDRA, "two")
    started(**more)
    require_connected(comm)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("rank", ["0", "1"])
def test_commands_and_programs_are_refused_and_the_first_rank_alone_reports(comm, started, monkeypatch, tmp_path,
                                                                            capfd, rank):
    from eddies.cli import main
    started(PMI_SIZE=1)
    monkeypatch.setenv("PMI_RANK", rank)
    monkeypatch.setattr("eddies.parallel.connection.PATIENCE", 0)
    assert main(["run", "abc", "--output", str(tmp_path / "run")]) == 2
    errors = capfd.readouterr().err
    assert errors.count("\n") == (rank == "0") and ("2 ranks were" in errors) == (rank == "0")
    with pytest.raises(eddies.UserError, match="MPI connects 1 of them"):
        eddies.run("abc", output=tmp_path / "run")
    assert not os.listdir(tmp_path)
