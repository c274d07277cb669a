"""A rank that fails anywhere ends the job soon, with an exit code and its number, and leaves no product."""

import re
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.commands import launched, on_ranks, python

PROGRAM = Path(__file__).with_name("broken_rank.py")
SECONDS = 10  # from the fault to the end of the job

# Place, kind, ranks, and whether the launcher starts the job.
CASES = [("transform", "SIGKILL", 3, True), ("halo", "RuntimeError", 2, True), ("product", "MemoryError", 2, False),
         ("checkpoint", "SIGSEGV", 2, False), ("halo", "SystemExit", 2, False), ("product", "SceneError", 2, True)]


@pytest.fixture(scope="module")
def jobs(tmp_path_factory):
    """The ended job of each case. Two run at once: most of their time is waiting for ranks to end."""
    with ThreadPoolExecutor(2) as pool:
        yield {case: pool.submit(break_job, *case, tmp_path_factory.mktemp("broken")) for case in CASES}


def break_job(place, kind, ranks, by_launcher, directory):
    """Run the program; exit code, error output, seconds from the fault until the last process is gone, directory."""
    program = PROGRAM, place, kind, directory
    ended = python(*launched(ranks, *program)) if by_launcher else on_ranks(ranks, *program)
    broke = float((directory / "broke").read_text())
    processes = [file.read_text() for file in directory.glob("process-*")]
    while any(map(is_alive, processes)) and time.time() < broke + SECONDS:  # mpirun may end before a rank it killed
        time.sleep(0.02)
    return ended.returncode, ended.stderr, time.time() - broke, directory


@pytest.mark.parametrize("case", CASES, ids=lambda case: "-".join(map(str, case[:3])))
def test_a_broken_rank_ends_the_job(jobs, case):
    place, kind, ranks, _ = case
    code, errors, seconds, directory = jobs[case].result()
    print(f"{place}, {kind}, {ranks} ranks: ended after {seconds:.1f} s, exit code {code}")
    assert code != 0 and seconds < SECONDS
    if kind.startswith("SIG"):
        assert re.search(r"process rank 1 .* exited on signal", errors)
    elif kind == "SceneError":  # a mistake of the user
        assert code == 2 and "rank 1: eddies: error: reactor leak" in errors and "Traceback" not in errors
    else:
        assert f"rank 1: {kind}: reactor leak" in errors and re.search(r"rank 1: +File .*, in broken", errors)
        assert "rank 0: Traceback" not in errors
    assert not (directory / "run/ground_truth.h5").exists() and not list(directory.glob("run/checkpoints/frames-*.h5"))
    assert len(list(directory.glob("process-*"))) == ranks
    if place == "checkpoint":  # the checkpoints before are whole
        names = {path.name for path in directory.glob("run/checkpoints/step-*")}
        assert names == {"step-00000000.h5", "step-00000001.h5.partial"}


def is_alive(process):
    """Whether a process exists and is not a zombie."""
    status = Path("/proc", process, "status")
    return status.exists() and not re.search(r"^State:\s+Z", status.read_text(), re.M)
