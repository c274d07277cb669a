"""`eddies check --time`: every stage is measured, on any number of ranks, and nothing is left behind."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from eddies.parallel.stop import Stopped
from eddies.scene.scene import load_scene
from eddies.workflows import timing
from tests.small_scene import TINY

LAUNCH = Path(__file__).parents[2] / "mpi_tools/launch.py"


@pytest.fixture
def measured(comm, tmp_path, monkeypatch, no_figures, quick_solves):
    """A function that measures a scene in a directory of all ranks, and gives the logged lines by stage."""
    found = {}
    monkeypatch.chdir(comm.bcast(str(tmp_path)))

    def note(form, *words):
        found[words[0]] = form % words

    monkeypatch.setattr(timing.log, "info", note)
    monkeypatch.setattr(timing, "duration", lambda seconds: f"{seconds:.9f}")

    def run(name, *overrides, removals=(), signals=()):
        try:
            timing.run(load_scene(name, list(overrides), removals), comm, signals)
        finally:
            comm.Barrier()
            assert list(Path().iterdir()) == []
        return found

    return run


@pytest.mark.mpi(1)
def test_every_stage_of_the_pipeline_is_measured(comm, measured):
    found = measured(TINY, "training.horizons.steps=5", "training.horizons.frames=[1, 2]")
    for stage, steps in {"dns": 82, "train-kernel": 200, "train": 60 + 2 * 5, "simulate": 5, "report": 0}.items():
        pace, count, seconds = map(float, re.match(rf"{stage} +(\S+) +(\d+)  (\S+)", found[stage]).groups())
        assert count == steps and (pace > 0) == (steps > 0) and seconds > 0.9 * pace * count


@pytest.mark.mpi(1)
def test_variants_and_their_search_for_a_step_are_measured(measured):
    kept = ["variant.local", "variant.paper", "variant.grid-20"]
    found = measured("tiny", "variant.resolved.model.path=nowhere", removals=kept)
    assert "not measured" in found["resolved: train"] and "resolved: simulate" not in found
    lines = [found[f"{name}: {stage}"] for name in ("grid-16", "no-force") for stage in ("find-step", "simulate")]
    assert found["dns"] and found["train-kernel"] and not any("not measured" in line for line in lines)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name", ["abc", "tracers-only"])
def test_scenes_without_a_model_are_measured(measured, name):
    found = measured(name)
    assert not any("not measured" in found[stage] for stage in load_scene(name).stages)


@pytest.mark.mpi(1, 2)
def test_a_signal_ends_it_with_nothing_left(measured):
    with pytest.raises(Stopped, match="SIGTERM; the same command starts again from the beginning"):
        measured(TINY, signals=[signal.SIGTERM])


def test_an_interrupt_leaves_nothing(tmp_path):
    command = [sys.executable, LAUNCH, "-n", "2", "--", sys.executable, "-m", "eddies", "check", TINY, "--time"]
    # A background job of a shell ignores the interrupt, and so do its children.
    job = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True,
                           env={**os.environ, "OMP_NUM_THREADS": "1"},
                           preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    end = time.monotonic() + 60
    while not list(tmp_path.glob("eddies-check-*/*")) and time.monotonic() < end:
        time.sleep(0.1)
    assert list(tmp_path.iterdir())
    os.killpg(job.pid, signal.SIGINT)  # the keyboard reaches the group
    _, errors = job.communicate(timeout=60)
    assert job.returncode == 130, errors
    assert list(tmp_path.iterdir()) == [] and "Traceback" not in errors
