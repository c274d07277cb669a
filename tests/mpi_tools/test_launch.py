"""Environment, ranks and error output of the launcher, and the doctor under it."""

from pathlib import Path

import numpy as np
import pytest

from mpi_tools import launch
from tests.commands import launched, python
from tests.small_scene import TINY

CHECKOUT = Path(__file__).parents[2]


def test_ranks_are_the_cores_or_fewer(monkeypatch):
    monkeypatch.setattr(launch, "local_cores", lambda: 4)
    monkeypatch.setattr(launch.os, "cpu_count", lambda: 8)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    for asked, ranks in {"": 4, "3": 3, "9": 4}.items():
        monkeypatch.setenv("EDDIES_RANKS", asked)
        assert launch.default_ranks() == ranks
    for threads, ranks in {"2": 2, "3": 1, "8": 1}.items():
        monkeypatch.setenv("OMP_NUM_THREADS", threads)
        assert launch.default_ranks() == ranks
    for asked in ("many", "0", "-1", "2.0", "\u00b2"):
        monkeypatch.setenv("EDDIES_RANKS", asked)
        with pytest.raises(ValueError, match=f'EDDIES_RANKS = "{asked}"'):
            launch.default_ranks()


def test_environment_of_the_user_wins(monkeypatch):
    monkeypatch.setattr(launch, "local_cores", lambda: 4)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.delenv("OMPI_MCA_rmaps_base_oversubscribe", raising=False)
    assert launch.mpi_environment(4)["OMP_NUM_THREADS"] == "1"
    assert "OMPI_MCA_rmaps_base_oversubscribe" not in launch.mpi_environment(4)
    assert launch.mpi_environment(5)["OMPI_MCA_rmaps_base_oversubscribe"] == "1"
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    assert launch.mpi_environment(4)["OMP_NUM_THREADS"] == "2"


RULE = 74 * "-" + "\n"
NOTICE = (f"{RULE}Primary job  terminated normally, but 1 process returned\na non-zero exit code. Per "
          f"user-direction, the job has been aborted.\n{RULE}{RULE}mpirun detected that one or more processes exited "
          "with non-zero status, thus causing\nthe job to be terminated. The first process to do so was:\n\n  "
          f"Process name: [[1,1],0]\n  Exit code:    CODE\n{RULE}")


@pytest.mark.parametrize("before, code, after", [
    ("eddies: error: no such reactor\n", 2, ""), ("eddies: stopped\n", 75, ""), ("eddies: interrupted\n", 130, ""),
    ("eddies: error: no such reactor\n", 2, "said later\n"), ("no line", 2, ""), (f"{RULE}mine\n{RULE}", 2, "")],
    ids=range(6))
def test_notices_that_repeat_what_ranks_have_said_are_left_out(before, code, after):
    """Wherever the bytes are cut; everything else passes unchanged."""
    content = (before + "\n" * (before == "no line") + NOTICE.replace("CODE", str(code)) + after).encode()
    for seed in range(20):
        cuts = np.sort(np.random.default_rng(seed).integers(0, len(content), 9))
        output = launch.ErrorOutput()
        passed = b"".join(output.pass_on(part.tobytes()) for part in np.split(np.frombuffer(content, np.uint8), cuts))
        assert (passed + output.rest()).decode() == before + "\n" * (before == "no line") + after


@pytest.mark.parametrize("content", [
    NOTICE.replace("CODE", "2"), "fault\n" + NOTICE.replace("CODE", "1"), RULE, f"{RULE}mpirun det", "half a li",
    f"a\n{RULE}MPI_ABORT was invoked on rank 1\n{RULE}", f"{RULE}{RULE}b\n", 40 * "-", "50 %\r60 %\r"], ids=range(9))
def test_all_else_is_passed_on(content):
    output = launch.ErrorOutput()
    passed = b"".join(output.pass_on(bytes([byte])) for byte in content.encode())
    assert (passed + output.rest()).decode() == content


def test_a_line_that_is_not_ended_is_passed_on_at_once():
    assert launch.ErrorOutput().pass_on(b"50 %\r") == b"50 %\r"


@pytest.mark.parametrize("arguments, code, words", [
    (["-m", "eddies", "check", TINY, "--set", "flow.cels=3"], 2, "did you mean cells?"),
    (["-c", "raise SystemExit(2)"], 2, "non-zero"), (["-c", "raise SystemExit(75)"], 75, "")])
def test_exit_code_is_that_of_the_ranks_and_a_refusal_is_one_line(arguments, code, words):
    ended = python(*launched(2, *arguments))
    assert ended.returncode == code and words in ended.stderr
    assert "eddies" not in arguments or ended.stderr.count("\n") == 1


def test_doctor_names_what_is_missing_and_leaves_no_file(tmp_path):
    modules, work = tmp_path / "modules", tmp_path / "work"
    modules.mkdir()
    work.mkdir()
    # These take long to import.
    (modules / "matplotlib.py").write_text("__version__ = '1'\n")
    (modules / "torch.py").write_text("from types import SimpleNamespace\n__version__ = '1'\n"
                                      "get_num_threads = lambda: 1\n"
                                      "cuda = SimpleNamespace(is_available=lambda: False)\n")
    code = (f"import os, sys, runpy; sys.path.insert(0, {str(modules)!r}); {{}}; "
            f"runpy.run_path({str(CHECKOUT / 'mpi_tools/doctor.py')!r}, run_name='__main__')")
    result = python(*launched(2, "-c", code.format("pass")), cwd=work)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "rank 0 of 2" in result.stdout and "rank 1 of 2" in result.stdout and "mpio" in result.stdout
    for name in ("pyfftw", "torch", "matplotlib"):
        (modules / f"{name}.py").write_text("raise ImportError('made up')")
    # A third rank that MPI does not connect.
    result = python(*launched(2, "-c", code.format("os.environ['OMPI_COMM_WORLD_SIZE'] = '3'")), cwd=work)
    assert not list(work.iterdir())
    assert result.returncode == 8  # four on each of two ranks
    assert "3 ranks were started" in result.stdout and "rank 1: pyfftw" in result.stdout
