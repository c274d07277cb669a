"""The MPI plugin, on small made-up test files in a pytest of their own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from mpi_tools.launch import local_cores

CHECKOUT = Path(__file__).parents[2]
HEAD = "import os, time\nimport numpy as np\nimport pytest\n\n\n"


def run(folder, body, *options):
    """Output and pytest's closing line for a test file with this body."""
    (folder / "test_made_up.py").write_text(HEAD + body)
    (folder / "pytest.ini").touch()  # a root folder of its own
    result = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "mpi_tools.pytest_mpi", "-v", "--color=no", *options],
        cwd=folder, env=os.environ | {"PYTHONPATH": str(CHECKOUT)}, timeout=120,
        capture_output=True, text=True)
    return result.stdout, result.stdout.splitlines()[-1]


PASSING = """
@pytest.mark.mpi(1, 2, 3)
def test_sum(comm, mpi_ranks, tmp_path):
    total = np.zeros(1)
    comm.Allreduce(np.ones(1), total)
    assert total[0] == comm.size == mpi_ranks
    (tmp_path / str(comm.rank)).touch()
    comm.Barrier()
    assert len(list(tmp_path.iterdir())) == comm.size


@pytest.mark.mpi(2)
@pytest.mark.parametrize("letter", ["a", "b"])
def test_two(comm, letter):
    pass


def test_unmarked():
    from mpi4py import MPI
    assert not MPI.Is_initialized()
"""


def test_runs_on_each_number_of_ranks_and_leaves_mpi_alone(tmp_path):
    output, closing = run(tmp_path, PASSING, "-k", "not mpi-2-a")
    assert " 5 passed" in closing and "failed" not in closing, output
    assert all(f"test_sum[mpi-{ranks}] PASSED" in output for ranks in (1, 2, 3))


@pytest.fixture(scope="module")
def failing(tmp_path_factory):
    """Output and closing line for tests that end in every way, each after another that failed."""
    return run(tmp_path_factory.mktemp("failing"), """
@pytest.mark.mpi(2, timeout=2)
def test_hangs(comm):
    if comm.rank == 1:
        time.sleep(1000)  # here
    comm.Barrier()


@pytest.mark.mpi(2)
def test_others_wait(comm):
    print("value", 40 + comm.rank)
    if comm.rank == 1:
        raise ValueError("raised while rank 0 is in a barrier")
    comm.Barrier()


@pytest.mark.mpi(2)
def test_leaves(comm):
    pytest.skip("no reason")


@pytest.mark.mpi(2)
@pytest.mark.xfail(reason="known")
def test_expected(comm):
    assert comm.size == 1


@pytest.fixture
def broken(comm):
    raise RuntimeError("in the fixture")


@pytest.mark.mpi(2)
def test_setup(broken):
    pass


@pytest.mark.mpi(2)
def test_dies(comm):
    if comm.rank == 1:
        os._exit(3)
    comm.Barrier()


@pytest.mark.mpi(2)
def test_after(comm):
    comm.Barrier()


def test_without_marker(comm):
    pass
""")


def test_the_rest_runs_after_a_failure(failing):
    output, closing = failing
    assert " 4 failed, 1 passed, 1 skipped, 1 xfailed, 1 error" in closing, output
    assert "test_after[mpi-2] PASSED" in output
    assert "needs @pytest.mark.mpi" in output


def test_failures_on_one_rank_hanging_and_dying_ranks_are_reported(failing):
    output, _ = failing
    assert "rank 1 of 2 failed in call" in output
    assert "Captured stdout of rank 1 call" in output and "value 41" in output
    assert "ValueError: raised while rank 0 is in a barrier" in output
    assert "failed in setup" in output and "in the fixture" in output
    assert "rank 1 of 2 did not finish\ndid not end within the time limit of 2 s" in output
    assert "test_made_up.py\", line 10 in test_hangs" in output
    assert "died; output of the run" in output


MEETING = """
@pytest.mark.mpi(1, timeout=40)
def test_meets(comm):
    open("{}", "w").close()
    while not os.path.exists("{}"):
        time.sleep(0.01)
"""


@pytest.mark.skipif(local_cores() < 2, reason="nothing runs beside another on one core")
def test_runs_on_one_rank_share_the_modules_and_others_start_beside_them(tmp_path):
    """Tests of two modules wait for each other. The rest of a module runs although a test of it died. Tests on two
    ranks do not wait for tests without any."""
    (tmp_path / "test_others.py").write_text(HEAD + MEETING.format("one", "two") + """

@pytest.mark.mpi(1)
def test_dies(comm):
    os._exit(3)


@pytest.mark.mpi(1)
def test_after(comm):
    pass
""")
    output, closing = run(tmp_path, MEETING.format("two", "one") + """

@pytest.mark.mpi(2)
def test_marked(comm):
    open(str(comm.size), "w").close()


@pytest.mark.parametrize("time_left", range(400, 0, -1))
def test_unmarked(time_left):
    if not os.path.exists("2"):
        time.sleep(0.1)
        assert time_left > 1
""")
    assert " 1 failed, 404 passed" in closing, output
    assert "test_dies[mpi-1] FAILED" in output and "test_after[mpi-1] PASSED" in output
