"""Ranks that MPI does not connect, told by what launchers leave in the environment."""

import os

import pytest

from eddies.parallel.connection import LAUNCHERS, SHELL, NotConnected, require_connected

MPIRUN, HYDRA, SLURM = LAUNCHERS


@pytest.fixture
def started(comm, monkeypatch):
    """Sets what launchers say: the number of ranks that each has started beyond those that MPI connects."""
    for name in (*LAUNCHERS, *LAUNCHERS.values(), SHELL):
        monkeypatch.delenv(name, raising=False)

    def set_numbers(**more):
        for name, number in more.items():
            monkeypatch.setenv(name, str(comm.size + number))
    return set_numbers


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("size, remedy", [(MPIRUN, "with the mpirun of "), (HYDRA, "with the mpirun of "),
                                          (SLURM, "with `srun --mpi=pmix`")])
@pytest.mark.parametrize("rank", ["0", "1", None])
def test_more_ranks_than_mpi_connects_are_refused(comm, started, monkeypatch, size, remedy, rank):
    started(**{size: 2})
    if rank is not None:
        monkeypatch.setenv(LAUNCHERS[size], rank)
    with pytest.raises(NotConnected) as refused:
        require_connected(comm)
    assert f"{comm.size + 2} ranks were started ({size}), MPI connects {comm.size} of them" in str(refused.value)
    assert remedy in str(refused.value) and f"unset {size}" in str(refused.value)
    assert refused.value.first == (rank != "1")


@pytest.mark.mpi(1)
def test_ranks_of_slurm_get_the_remedy_of_slurm(comm, started):
    started(PMI_SIZE=1, SLURM_STEP_NUM_TASKS=1)  # srun --mpi=pmi2 sets both
    with pytest.raises(NotConnected, match="with `srun --mpi=pmix`"):
        require_connected(comm)


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("told", [
    {}, {MPIRUN: 0}, {HYDRA: 0}, {SLURM: 0}, {HYDRA: -1},
    pytest.param({MPIRUN: 0, HYDRA: 1, SLURM: 1}, id="mpirun in a step of Slurm"),
    pytest.param({HYDRA: 0, SLURM: 1}, id="mpiexec in a step of Slurm"),
    pytest.param({HYDRA: 1, SLURM: 1, SHELL: 30000}, id="by hand in a shell of srun --pty")])
def test_ranks_that_mpi_connects_are_let_pass(comm, started, told):
    started(**told)
    require_connected(comm)


@pytest.mark.mpi(1)
def test_a_number_that_is_none_tells_nothing(comm, started, monkeypatch):
    started()
    for text in ("", "two"):
        monkeypatch.setenv(HYDRA, text)
        require_connected(comm)


@pytest.mark.mpi(1)
def test_programs_are_refused_as_well(comm, started, tmp_path):
    import eddies
    started(PMI_SIZE=1)
    with pytest.raises(eddies.UserError, match="MPI connects 1 of them"):
        eddies.run("abc", output=tmp_path / "run")
    assert not os.listdir(tmp_path)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("rank", ["0", "1"])
def test_the_first_rank_alone_says_so(comm, started, monkeypatch, tmp_path, capfd, rank):
    from eddies.cli import main
    started(PMI_SIZE=1)
    monkeypatch.setenv("PMI_RANK", rank)
    monkeypatch.setattr("eddies.parallel.rendezvous.PATIENCE", 0)
    assert main(["run", "abc", "--output", str(tmp_path / "run")]) == 2
    errors = capfd.readouterr().err
    assert errors.count("\n") == (rank == "0") and errors.startswith("eddies: error: 2 ranks were" * (rank == "0"))
    assert not os.listdir(tmp_path)
