"""A direct simulation that is stopped and continued equals the one that was never stopped."""

import hashlib
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from eddies.io.checkpoint import Checkpoint
from eddies.io.hdf5 import open_product, read_attributes, read_table
from eddies.io.trajectories import Trajectory
from eddies.parallel.stop import Stopped
from eddies.scene.scene import load_scene
from eddies.workflows import dns
from tests.small_scene import TINY
from tests.workflows.stopping import StopAtStep

# Eight steps of spin-up, twelve with tracers in four frame intervals.
SPLIT = ["flow.cells=12", "tracers.particles_per_side=5", "tracers.field_cells=8", "spin_up.turnovers=0.08",
         "spin_up.stationary=0.04", "tracers.turnovers=0.15", "tracers.frame_interval=0.06",
         "simulation.frame_interval=0.06", "tracers.field_every=2", "time.max_step=0.025", "kernel.neighbors=20",
         "training.batch=9"]
STEPS = 20
# The first and last steps of both parts, and a step between two frames.
SPLITS = (0, 7, 8, 10, 19)


@pytest.fixture
def last(monkeypatch):
    """The run and the guard of the last step."""
    seen = SimpleNamespace()

    class SeeingGuard(dns.Guard):
        def __call__(self, run, segments=None):
            seen.run, seen.guard = run, self
            super().__call__(run, segments)

    monkeypatch.setattr(dns, "Guard", SeeingGuard)
    return seen


def fingerprint(last):
    """SHA-256 of this rank's part of state, clock, history, and tracers by id."""
    run, tracers = last.run, last.run.tracers.tracers.columns
    order = np.argsort(tracers["id"])
    rows = [[value for name, value in sorted(row.items()) if name != "seconds_per_step"] for row in run.history.rows]
    digest = hashlib.sha256(run.state.tobytes())
    for values in (rows, [run.clock.time, run.clock.steps], *(tracers[name][order] for name in sorted(tracers))):
        digest.update(np.array(values).tobytes())
    return digest.hexdigest()


def product(comm, path):
    """All numbers of a ground truth, except times of the run."""
    with open_product(comm, path / "ground_truth.h5", "ground_truth") as file:
        trajectory = Trajectory(file, "tracers")
        tables = {f"{table}/{name}": values for table in ("statistics", "spectra", "spectra_of_statistics")
                  for name, values in read_table(file, table).items() if name != "seconds_per_step"}
        tables |= read_attributes(file, "reference") | read_attributes(file, "stationary")
        tables |= {"frames": trajectory.times, "fields": file["fields/filtered/velocity"][()],
                   "whole": file["fields/unfiltered/velocity"][()]}
        tables |= {name: np.stack([trajectory.read(frame, name) for frame in range(len(trajectory.times))])
                   for name in trajectory.columns}
    return tables


@pytest.mark.mpi(2)
def test_a_split_of_a_run_is_the_whole_run(comm, tmp_path, last, monkeypatch):
    monkeypatch.setattr("eddies.io.checkpoint.KEPT", 100)
    scene, whole = load_scene(TINY, SPLIT), tmp_path / "whole"
    if comm.rank == 0:
        whole.mkdir()
    comm.Barrier()
    # Keep the checkpoints that a finished run removes.
    monkeypatch.setattr("eddies.io.checkpoint.CheckpointDirectory.remove", lambda self: None)
    dns.run(scene, comm, whole, StopAtStep(comm, every_step=True))
    expected, truth = fingerprint(last), product(comm, whole)
    assert last.run.clock.steps == STEPS
    assert len(truth["frames"]) == 5 and len(list((whole / "checkpoints").glob("step-*"))) == STEPS
    for split in SPLITS:
        directory = tmp_path / f"split-{split}"
        if comm.rank == 0:
            (directory / "checkpoints").mkdir(parents=True)
            for path in (whole / "checkpoints" / f"step-{split:08d}.h5", *(whole / "checkpoints").glob("frames-*")):
                shutil.copy(path, directory / "checkpoints")
        comm.Barrier()
        dns.run(scene, comm, directory, StopAtStep(comm))
        assert fingerprint(last) == expected, split
        again = product(comm, directory)
        for name, values in truth.items():
            assert np.array_equal(again[name], values), (split, name)


@pytest.mark.mpi(1)
def test_forcing_stays_on_over_a_restart(comm, tmp_path, last):
    scene, found = load_scene(TINY, [*SPLIT, "tracers.forced=true"]), {}
    for name, steps in (("whole", 10**9), ("split", 14)):  # within the time of the tracers
        (tmp_path / name).mkdir()
        if steps < STEPS:
            with pytest.raises(Stopped):
                dns.run(scene, comm, tmp_path / name, StopAtStep(comm, steps))
        dns.run(scene, comm, tmp_path / name)
        found[name] = product(comm, tmp_path / name)
    assert all(np.array_equal(found["split"][name], values) for name, values in found["whole"].items())
    assert len(found["whole"]["whole"]) == 1 and last.run.fluid.forcing is not None


@pytest.mark.mpi(2)
def test_a_stopped_run_continues_and_leaves_nothing_else(comm, tmp_path, last):
    scene = load_scene(TINY, SPLIT)
    for _ in range(2):  # in spin-up, then with tracers: the second stop is the resumed run's
        with pytest.raises(Stopped, match="from step"):
            dns.run(scene, comm, tmp_path, StopAtStep(comm, 7))
    comm.Barrier()
    assert not (tmp_path / "ground_truth.h5").exists() and not (tmp_path / "ground_truth.h5.partial").exists()
    dns.run(scene, comm, tmp_path, StopAtStep(comm))
    assert last.run.clock.steps == STEPS
    comm.Barrier()
    assert [path.name for path in tmp_path.iterdir()] == ["ground_truth.h5"]


@pytest.mark.mpi(1)
def test_a_checkpoint_of_other_settings_is_not_used(comm, tmp_path, last, caplog):
    with pytest.raises(Stopped):
        dns.run(load_scene(TINY, SPLIT), comm, tmp_path, StopAtStep(comm, 5))
    with caplog.at_level("WARNING", "eddies"), pytest.raises(Stopped, match="from step 2"):
        dns.run(load_scene(TINY, [*SPLIT, "seed=5"]), comm, tmp_path, StopAtStep(comm, 2))
    assert "step-00000005" in caplog.text and "other settings" in caplog.text


@pytest.mark.mpi(1)
def test_a_run_without_tracers_continues(comm, tmp_path, last):
    scene = load_scene("taylor-green", ["flow.cells=12", "time.duration=0.2", "time.step=0.02"])
    for split in (0, 4):
        with pytest.raises(Stopped):
            dns.run(scene, comm, tmp_path, StopAtStep(comm, split))
    dns.run(scene, comm, tmp_path)
    assert last.run.clock.steps == 10 and last.run.clock.time == pytest.approx(0.2)


@pytest.mark.mpi(3)
@pytest.mark.parametrize("before, after", [(2, 3), (3, 1)])
def test_another_number_of_ranks(comm, tmp_path, last, before, after):
    # Stopped at step 10, within a frame interval; 20 more follow.
    scene, run = load_scene(TINY, [*SPLIT, "tracers.turnovers=0.36"]), tmp_path / "run"
    groups = {size: comm.Split(int(comm.rank < size)) for size in (before, after)}
    if comm.rank == 0:
        run.mkdir()
    comm.Barrier()
    if comm.rank < before:
        for steps in (7, 3):
            with pytest.raises(Stopped):
                dns.run(scene, groups[before], run, StopAtStep(groups[before], steps))
        groups[before].Barrier()
        if comm.rank == 0:
            shutil.copytree(run, tmp_path / "same")
        groups[before].Barrier()
        dns.run(scene, groups[before], tmp_path / "same")
    comm.Barrier()
    if comm.rank < after:
        with pytest.raises(Stopped):
            dns.run(scene, groups[after], run, StopAtStep(groups[after], 0))
        name = "step-00000010.h5"
        if comm.rank == 0:
            (run / "checkpoints" / name).rename(tmp_path / name)
        groups[after].Barrier()
        last.guard.save(last.run, last.run.tracers.segments)
        saved = [Checkpoint(path / name) for path in (run / "checkpoints", tmp_path)]
        for name in ("modes", "position", "velocity", "history_time", "spectra_of_history"):
            assert np.array_equal(*(checkpoint.read(name) for checkpoint in saved)), name
        dns.run(scene, groups[after], run)
        assert last.run.clock.steps >= 30
        same, other = (product(groups[after], path) for path in (tmp_path / "same", run))
        for name, values in same.items():
            # Fields are in single precision.
            tolerance = 1e-6 if name == "fields" else 1e-12
            assert np.abs(other[name] - values).max() <= tolerance * max(np.abs(values).max(), 1), name
    comm.Barrier()
