"""A direct simulation that is stopped and continued equals the one that was never stopped."""

import shutil

import numpy as np
import pytest

from eddies.io.checkpoint import Checkpoint
from eddies.io.provenance import product_provenance
from eddies.parallel.stop import Stopped
from eddies.scene.scene import SceneError, load_scene
from eddies.workflows import dns
from tests.small_scene import TINY
from tests.workflows.contents import assert_same, numbers_in
from tests.workflows.stopping import StopAtStep

# Eight steps of spin-up, twelve with tracers in four frame intervals.
SPLIT = ["flow.cells=12", "tracers.particles_per_side=5", "tracers.field_cells=8", "spin_up.turnovers=0.08",
         "spin_up.stationary=0.04", "tracers.turnovers=0.15", "tracers.frame_interval=0.06",
         "simulation.frame_interval=0.06", "tracers.field_every=2", "time.max_step=0.025", "kernel.neighbors=20",
         "training.batch=9"]
STEPS = 20
# The first step, the first with tracers, one between two frames, and the last.
SPLITS = (0, 8, 10, 19)


FRAMES = "particles/tracers/position/time"


def product(comm, directory):
    return numbers_in(comm, directory / "ground_truth.h5")


@pytest.fixture
def last(monkeypatch):
    """A list with the last run and its guard."""
    seen = [None, None]

    class SeeingGuard(dns.Guard):
        def __call__(self, run, segments=None):
            seen[:] = run, self
            super().__call__(run, segments)

    monkeypatch.setattr(dns, "Guard", SeeingGuard)
    return seen


@pytest.mark.mpi(2)
def test_a_split_of_a_run_is_the_whole_run(comm, tmp_path, monkeypatch):
    monkeypatch.setattr("eddies.io.checkpoint.KEPT", 100)
    scene, whole = load_scene(TINY, SPLIT), tmp_path / "whole"
    whole.mkdir(exist_ok=True)
    # Keep the checkpoints that a finished run removes.
    monkeypatch.setattr("eddies.io.checkpoint.CheckpointDirectory.remove", lambda self: None)
    dns.run(scene, comm, whole, StopAtStep(comm, every_step=True))
    truth = product(comm, whole)
    assert len(truth[FRAMES]) == 5 and len(list((whole / "checkpoints").glob("step-*"))) == STEPS + 1
    for split in SPLITS:
        directory = tmp_path / f"split-{split}"
        if comm.rank == 0:
            (directory / "checkpoints").mkdir(parents=True)
            for path in (whole / "checkpoints" / f"step-{split:08d}.h5", *(whole / "checkpoints").glob("frames-*")):
                shutil.copy(path, directory / "checkpoints")
        comm.Barrier()
        dns.run(scene, comm, directory)
        assert_same(product(comm, directory), truth, split)


@pytest.mark.mpi(2)
def test_a_stopped_run_continues_with_its_forcing_and_leaves_nothing_else(comm, tmp_path, caplog):
    scene, (whole, run) = load_scene(TINY, [*SPLIT, "tracers.forced=true"]), (tmp_path / "whole", tmp_path / "run")
    for path in (whole, run):
        path.mkdir(exist_ok=True)
    dns.run(scene, comm, whole)
    with pytest.raises(Stopped):
        dns.run(load_scene(TINY, [*SPLIT, "seed=5"]), comm, run, StopAtStep(comm, 5))
    for _ in range(2):  # in spin-up, then with tracers: the second stop is the resumed run's
        with pytest.raises(Stopped, match="from step"):
            dns.run(scene, comm, run, StopAtStep(comm, 7))
    assert comm.rank > 0 or "step-00000005" in caplog.text and "other settings" in caplog.text
    comm.Barrier()
    assert not list(run.glob("ground_truth.h5*"))
    comm.Barrier()
    dns.run(scene, comm, run)
    assert_same(product(comm, run), product(comm, whole))
    assert sorted(path.name for path in run.iterdir()) == ["checkpoints", "ground_truth.h5"]
    assert [path.name for path in (run / "checkpoints").iterdir()] == ["step-00000020.h5"]


@pytest.mark.mpi(1)
def test_a_run_without_tracers_continues(comm, tmp_path, last):
    """After two stops, and after its end for longer, but not for less."""
    keys = ["flow.cells=12", "time.step=0.02"]  # ten steps of 0.02 are not exactly 0.2
    scene = load_scene("taylor-green", [*keys, "time.duration=0.2"])
    for split in (0, 4):
        with pytest.raises(Stopped):
            dns.run(scene, comm, tmp_path, StopAtStep(comm, split))
    dns.run(scene, comm, tmp_path)
    assert last[0].clock.steps == 10 and last[0].clock.time == pytest.approx(0.2)
    dns.run(load_scene("taylor-green", [*keys, "time.duration=0.3"]), comm, tmp_path)
    assert last[0].clock.steps == 15 and last[0].clock.time == pytest.approx(0.3)
    with pytest.raises(SceneError, match="duration = 0.2: the checkpoint in .* is later than .*; raise the key, or"):
        dns.run(scene, comm, tmp_path)


@pytest.mark.mpi(1, 2)
def test_a_finished_run_goes_on_for_longer(comm, tmp_path, caplog):
    scene, (whole, run) = load_scene(TINY, SPLIT), (tmp_path / "whole", tmp_path / "run")
    short = load_scene(TINY, [*SPLIT, "tracers.turnovers=0.09"])
    for path in (whole, run):
        path.mkdir(exist_ok=True)
    dns.run(scene, comm, whole)
    expected = product(comm, whole)
    dns.run(short, comm, run)
    found, made = product(comm, run), product_provenance(run / "ground_truth.h5")
    assert len(found[FRAMES]) < len(expected[FRAMES])
    caplog.set_level("INFO", "eddies")
    caplog.clear()
    with pytest.raises(Stopped):
        dns.run(scene, comm, run, StopAtStep(comm, 2))
    dns.run(scene, comm, run)
    assert caplog.text.count("continues from step") == 2
    assert product_provenance(run / "ground_truth.h5")["id"] == made["id"]
    found = product(comm, run)
    # A state of the whole flow, from which coarse grids start, is stored where either length asks for it, if it is not
    # too late: the first of both is the same.
    for numbers in (found, expected):
        numbers |= {name: values[:1] for name, values in numbers.items()
                    if name.startswith("fields/unfiltered/") and np.ndim(values)}
    assert_same(found, expected)
    with pytest.raises(SceneError, match="turnovers = 0.09: the checkpoint in"):
        dns.run(short, comm, run)
    comm.Barrier()
    if comm.rank == 0:
        (run / "ground_truth.h5").unlink()
    comm.Barrier()
    dns.run(short, comm, run)  # without its frames the checkpoint is worth nothing
    assert comm.rank > 0 or "lacks the frames before the checkpoint" in caplog.text
    assert len(product(comm, run)[FRAMES]) < len(expected[FRAMES])


@pytest.mark.mpi(3)
@pytest.mark.parametrize("before, after", [(2, 3), (3, 1)])
def test_another_number_of_ranks(comm, tmp_path, last, before, after):
    """Stopped at step 10, within a frame interval. The checkpoint that the other ranks write at once is the same."""
    scene, run, same = load_scene(TINY, SPLIT), tmp_path / "run", tmp_path / "same"
    groups = {size: comm.Split(int(comm.rank < size)) for size in (before, after)}
    run.mkdir(exist_ok=True)
    if comm.rank < before:
        with pytest.raises(Stopped):
            dns.run(scene, groups[before], run, StopAtStep(groups[before], 10))
        groups[before].Barrier()
        if comm.rank == 0:
            shutil.copytree(run, same)
        groups[before].Barrier()
        dns.run(scene, groups[before], same)
    comm.Barrier()
    if comm.rank < after:
        with pytest.raises(Stopped):
            dns.run(scene, groups[after], run, StopAtStep(groups[after], 0))
        name, (flow, guard) = "step-00000010.h5", last
        if comm.rank == 0:
            (run / "checkpoints" / name).rename(tmp_path / name)
        groups[after].Barrier()
        guard.save(flow, flow.tracers.segments)
        saved = [Checkpoint(path / name) for path in (run / "checkpoints", tmp_path)]
        for name in ("modes", "position", "velocity", "history_time", "spectra_of_history"):
            assert np.array_equal(*(checkpoint.read(name) for checkpoint in saved)), name
        dns.run(scene, groups[after], run)
        expected, found = (product(groups[after], path) for path in (same, run))
        for name, values in expected.items():
            # Fields are in single precision.
            tolerance = 1e-6 if name.startswith("fields/") else 1e-12
            if np.asarray(values).dtype.kind in "fi":
                assert np.abs(found[name] - values).max() <= tolerance * max(np.abs(values).max(), 1), name
    comm.Barrier()
