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
def told(comm, tmp_path, monkeypatch):
    """A function that measures a scene in a directory of all ranks, and gives what is logged by stage."""
    found = {}
    monkeypatch.chdir(comm.bcast(str(tmp_path)))

    def note(form, *words):
        if words:
            found[words[0]] = form % words

    monkeypatch.setattr(timing.log, "info", note)

    def measured(name, *overrides, signals=()):
        timing.run(load_scene(name, list(overrides)), comm, signals)
        comm.Barrier()
        assert list(Path().iterdir()) == []
        return found

    return measured


@pytest.mark.mpi(1, 2, 3)
def test_every_stage_of_the_pipeline_is_measured(comm, told, no_figures, quick_solves):
    horizons = ["training.horizons.steps=5", "training.horizons.frames=[1, 2]"] if comm.size == 1 else []
    found = told(TINY, *horizons)
    trained = 60 + 5 * len(horizons)
    for stage, steps in {"dns": 82, "train-kernel": 200, "train": trained, "simulate": 5, "report": 0}.items():
        pace, count = re.match(rf"{stage} +(\S+) +(\d+)  ", found[stage]).groups()
        assert int(count) == steps and (float(pace) > 0) == (steps > 0)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name, overrides", [
    ("abc", []), ("tracers-only", []), (TINY, ["simulation.method=eulerian"]), (TINY, ["simulation.method=none"])])
def test_scenes_without_a_model_are_measured(told, no_figures, name, overrides):
    found = told(name, *overrides)
    for stage in load_scene(name, overrides).stages:
        assert "not measured" not in found[stage]


@pytest.mark.mpi(1, 2)
def test_what_cannot_be_measured_is_said_and_the_rest_is_measured(told, no_figures):
    found = told("hit-mt008", "flow.cells=32", "tracers.particles_per_side=8", "tracers.field_cells=12")
    assert "not measured: " in found["train"] and "model.h5" in found["train"]
    assert "not measured" not in found["dns"]


@pytest.mark.mpi(1, 2)
def test_a_signal_ends_it_with_nothing_left(comm, told):
    with pytest.raises(Stopped, match="SIGTERM; the same command goes on from the beginning"):
        told(TINY, signals=[signal.SIGTERM])
    comm.Barrier()
    assert list(Path().iterdir()) == []


@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 75)])
def test_an_interrupt_leaves_nothing(tmp_path, number, code):
    command = [sys.executable, LAUNCH, "-n", "2", "--", sys.executable, "-m", "eddies", "check", "hit-small", "--time"]
    # A shell's background job ignores the interrupt, and hands that down.
    job = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True,
                           env={**os.environ, "OMP_NUM_THREADS": "1"},
                           preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    end = time.monotonic() + 60
    while not list(tmp_path.glob("eddies-check-*/*")) and time.monotonic() < end:
        time.sleep(0.1)
    assert list(tmp_path.iterdir())
    os.killpg(job.pid, number) if number == signal.SIGINT else job.send_signal(number)  # the first as the keyboard does
    _, errors = job.communicate(timeout=60)
    assert job.returncode == code, errors
    assert list(tmp_path.iterdir()) == [] and "Traceback" not in errors
