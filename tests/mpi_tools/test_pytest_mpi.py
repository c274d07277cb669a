"""The MPI plugin, on small made-up test files in a pytest of their own."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from mpi_tools.launch import mpi_environment, mpirun_command
from mpi_tools.pytest_mpi import pytest_collection_modifyitems

CHECKOUT = Path(__file__).parents[2]


def run(folder, body, ranks=None):
    """The exit code and the output of pytest for a test file with this body: on some ranks with -m mpi, or without."""
    (folder / "test_made_up.py").write_text(f"import os, time\nimport pytest\n{body}")
    line = [sys.executable, "-m", "pytest", "-p", "mpi_tools.pytest_mpi", "-c", CHECKOUT / "setup.cfg", "--rootdir",
            folder, "-p", "no:cacheprovider", "-vv", "--color=no", folder, *(["-m", "mpi"] if ranks else [])]
    ended = subprocess.run(mpirun_command(ranks, line) if ranks else line, cwd=folder, timeout=60,
                           env=mpi_environment(ranks or 1) | {"PYTHONPATH": str(CHECKOUT)},
                           stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    return ended.returncode, ended.stdout


SELECTED = """
@pytest.mark.mpi(1, 2)
def test_shares_a_folder(comm, tmp_path):
    (tmp_path / str(comm.rank)).touch()
    comm.Barrier()
    assert len(list(tmp_path.iterdir())) == comm.size


@pytest.mark.mpi(1, 3)
@pytest.mark.parametrize("letter", ["a", "b"])
def test_odd(comm, letter):
    assert comm.size != 2


def test_unmarked():
    from mpi4py import MPI
    assert not MPI.Is_initialized()
"""


@pytest.mark.parametrize("ranks, names, others", [
    (None, ["test_unmarked"], 3), (1, ["test_shares_a_folder", "test_odd[a]", "test_odd[b]"], 1),
    (2, ["test_shares_a_folder"], 3), (3, ["test_odd[a]", "test_odd[b]"], 2)])
def test_the_tests_for_a_number_of_ranks_run_and_are_shown_once(tmp_path, ranks, names, others):
    code, output = run(tmp_path, SELECTED, ranks)
    assert code == 0 and f" {len(names)} passed, {others} deselected in " in output, output
    assert output.count("PASSED") == len(names) and all(f"{name} PASSED" in output for name in names)


def test_a_number_of_ranks_without_tests_is_no_failure(tmp_path):
    """A file without any is not imported."""
    code, output = run(tmp_path, "raise ImportError('never read')\n", 2)
    assert code == 0 and "no tests ran in " in output, output


FAILING = """
{}

@pytest.fixture
def fixture(comm):
    assert comm.rank != 1 or "{}" != "setup"


@pytest.mark.mpi(2)
def test_fails(comm, fixture):
    print("value", 40 + comm.rank)
    assert comm.rank != 1 or "{}" != "call", "rank 0 is in a barrier"
    comm.Barrier()
    comm.Barrier()


@pytest.mark.mpi(2)
def test_after(comm):
    pass
"""


@pytest.mark.parametrize("phase", ["collect", "setup", "call"])
def test_a_failure_on_one_rank_is_reported_and_ends_the_job(tmp_path, phase):
    on_import = "from mpi4py import MPI\nassert MPI.COMM_WORLD.rank == 0" if phase == "collect" else ""
    code, output = run(tmp_path, FAILING.format(on_import, phase, phase), 2)
    assert code != 0 and "test_after" not in output, output
    assert "rank 1 of 2: test_made_up.py" in output and f" failed in {phase}\n" in output, output
    assert "AssertionError" in output, output
    if phase == "call":
        assert "rank 0 is in a barrier" in output and "--- Captured stdout call ---\nvalue 41\n" in output, output


def test_a_failure_on_the_only_rank_is_as_without_mpi(tmp_path):
    code, output = run(tmp_path, FAILING.replace("(2)", "(1)").replace("!= 1", "!= 0").format("", "", "call"), 1)
    assert code == 1 and " 1 failed, 1 passed in " in output, output


def test_a_hanging_test_ends_at_its_time_limit_with_the_stacks_of_all_ranks(tmp_path):
    code, output = run(tmp_path, """
@pytest.mark.mpi(2, timeout=1)
def test_hangs(comm):
    if comm.rank == 1:
        time.sleep(1000)
    comm.Barrier()
""", 2)
    assert code != 0 and "Timeout (0:00:01)!" in output, output
    assert all(f'test_made_up.py", line {line} in test_hangs' in output for line in (7, 8)), output


def test_a_rank_that_leaves_ends_the_job(tmp_path):
    code, output = run(tmp_path, """
@pytest.mark.mpi(2)
def test_leaves(comm):
    if comm.rank == 1:
        os._exit(0)
    comm.Barrier()
""", 2)
    assert code != 0 and "passed" not in output, output


@pytest.mark.parametrize("numbers", [(), (4,), (1, 4)])
def test_a_mark_without_a_number_of_ranks_that_is_tested_is_refused(numbers):
    item = SimpleNamespace(nodeid="test_never_runs", get_closest_marker=lambda name: SimpleNamespace(args=numbers))
    with pytest.raises(pytest.UsageError, match=r"test_never_runs: mpi\("):
        pytest_collection_modifyitems([item])
