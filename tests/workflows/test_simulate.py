"""Rollouts: stopped and continued as if never stopped; their steps, frames and times."""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from eddies.clock import ProgressLine
from eddies.io.checkpoint import Checkpoint, Guard
from eddies.io.frame_segments import FrameSegments
from eddies.io.hdf5 import create_product, open_product
from eddies.io.trajectories import Trajectory
from eddies.parallel.stop import Stopped
from eddies.particles.particle_set import ParticleSet
from eddies.scene.scene import BOX_LENGTH, Eulerian, Model
from eddies.workflows import simulate
from eddies.workflows.simulate import Course, frame_layout
from tests.commands import first_rank
from tests.workflows.contents import assert_same, numbers_in
from tests.workflows.small_rollout import prepared, scales_of, with_method, write_model
from tests.workflows.stopping import StopAtStep

pytestmark = pytest.mark.usefixtures("unmeasured", "quick_solves")

MODELS = {
    "default": Model(preset="resolved + pairs"),
    "density inputs": Model(preset="resolved + pairs", settings={"pairs": {
        "inputs": ("density", "distance", "speed", "approach")}}),
    "own density": Model(terms=("pairs", "density-flux", "continuity"), settings={"continuity": {"diffusion": 0.1}}),
    "local": Model(preset="local"),
}
# Number of inputs of all networks.
FEATURES = {"default": 3, "density inputs": 5, "own density": 10, "local": 0}
# Frames are 0.04 apart. Steps of 0.03 go beyond them; with other integrators frames are at the ends of steps.
CASES = {
    "default": ("default", "learned", {"step": 0.03, "skin": 0.3}),
    "density inputs, forced, Verlet": ("density inputs", "learned", {
        "step": 0.02, "injection": "dissipation", "integrator": "verlet", "skin": 0.3}),
    "own density": ("own density", "learned", {"step": 0.015, "turnovers": 0.06, "precision": "float64"}),
    "local": ("local", "learned", {"step": 0.03}),
    "eulerian": (None, "eulerian", {"step": 0.02, "injection": 1.0}),
    "none": (None, "none", {"step": 0.015}),
}


@pytest.fixture(scope="module")
def products(comm, shared_folder):
    """A folder with a ground truth, a kernel, and each of the models, and the scene."""
    folder = shared_folder()
    scene = prepared(comm, folder / "run", side=9, overrides=["tracers.field_cells=12"])  # enough for three slabs
    scales = scales_of(comm, folder / "run")
    for name, model in MODELS.items():
        (folder / name).mkdir(exist_ok=True)
        write_model(comm, folder / name, replace(scene, model=model), scales, 0.5, FEATURES[name])
    return folder, scene


@pytest.fixture
def case_of(products, linked):
    """Scene and a directory with the products it starts from, of a case by name."""
    folder, scene = products

    def case(name):
        model, method, keys = CASES[name]
        simulation = replace(scene.simulation, method=method, **{"turnovers": 0.11, **keys})
        coarse = {"eulerian": Eulerian(cells=12, closure="dynamic-smagorinsky")} if method == "eulerian" else {}
        return (replace(scene, model=MODELS.get(model, scene.model), simulation=simulation, **coarse),
                linked(folder / "run", *([folder / model] if model else [])))

    return case


def product(comm, directory):
    return numbers_in(comm, directory / "rollout.h5")


def check_splits(comm, scene, directory, monkeypatch, each=1):
    """Continue from each, or each second, ... of these: the first step, the second, one after a frame, the last.
    Returns the checkpoints of all steps."""
    monkeypatch.setattr("eddies.io.checkpoint.KEPT", 100)
    with monkeypatch.context() as patch:
        patch.setattr("eddies.io.checkpoint.CheckpointDirectory.remove", lambda self: None)
        simulate.run(scene, comm, directory, StopAtStep(comm, every_step=True))
    whole, saved, checkpoints = product(comm, directory), directory / "saved", directory / "checkpoints-rollout"
    steps, at_frames = int(whole["rollout/steps"]), sorted(set(whole["particles/model/position/step"].tolist()))
    assert whole["rollout/status"] == "complete" and len(at_frames) >= 2
    first_rank(comm, checkpoints.rename, saved)
    found = sorted(saved.glob("step-*"))
    assert len(found) == steps >= 3
    for split in sorted({0, 1, at_frames[1], steps - 1} - {steps})[each - 1::each]:
        if comm.rank == 0:
            checkpoints.mkdir()
            for path in saved.glob("frames-*.h5"):
                shutil.copy(path, checkpoints)
            shutil.copy(saved / f"step-{split:08d}.h5", checkpoints)
            (directory / "rollout.h5").unlink()
        comm.Barrier()
        simulate.run(scene, comm, directory)
        assert_same(product(comm, directory), whole, split)
    assert not checkpoints.exists()
    return [Checkpoint(path) for path in found]


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name", CASES)
def test_every_split_of_a_rollout_is_the_whole_rollout(comm, case_of, monkeypatch, name):
    check_splits(comm, *case_of(name), monkeypatch)


@pytest.mark.mpi(3)
@pytest.mark.parametrize("name", ["density inputs, forced, Verlet", "own density", "eulerian"])
def test_splits_on_several_ranks(comm, case_of, monkeypatch, name):
    states = check_splits(comm, *case_of(name), monkeypatch, each=3)
    if name == "own density":  # a list that is built at the present positions changes the order of sums over pairs
        assert any((state["particles built at"] != state["particles position"]).any() for state in states
                   if "built at" in state["columns"])


@pytest.mark.mpi(2)
def test_a_stopped_rollout_continues_and_leaves_nothing_else(comm, small_products, linked):
    scene, directory = with_method(small_products[0], "learned", step=0.03, turnovers=0.11), linked(small_products[1])
    names = {path.name for path in directory.iterdir()}
    simulate.run(scene, comm, directory)
    whole = product(comm, directory)
    first_rank(comm, (directory / "rollout.h5").unlink)
    for number in (1, 2):
        with pytest.raises(Stopped, match=f"from step {number} of the rollout"):
            simulate.run(scene, comm, directory, StopAtStep(comm, 1))
    comm.Barrier()
    assert {path.name for path in directory.iterdir()} == names | {"checkpoints-rollout"}
    comm.Barrier()
    simulate.run(scene, comm, directory)
    assert_same(product(comm, directory), whole, "after two stops")
    assert {path.name for path in directory.iterdir()} == names | {"rollout.h5"}


@pytest.mark.mpi(3)
@pytest.mark.parametrize("name, before, after", [("default", 1, 2), ("own density", 2, 3), ("eulerian", 3, 1)])
def test_another_number_of_ranks_goes_on_to_rounding(comm, case_of, name, before, after):
    scene, directory = case_of(name)
    groups = {size: comm.Split(int(comm.rank < size)) for size in (before, after)}
    if comm.rank < before:
        simulate.run(scene, groups[before], directory)
        whole = product(groups[before], directory)
        with pytest.raises(Stopped):
            simulate.run(scene, groups[before], directory, StopAtStep(groups[before], 2))
    comm.Barrier()
    if comm.rank < after:
        simulate.run(scene, groups[after], directory)
        other = product(groups[after], directory)
    if comm.rank == 0:
        assert other["rollout/steps"] == whole["rollout/steps"]
        for column in ("position", "velocity", "acceleration"):
            values = whole[f"particles/model/{column}/value"]
            difference = other[f"particles/model/{column}/value"] - values
            if column == "position":
                difference -= BOX_LENGTH * np.rint(difference / BOX_LENGTH)
            # Frames and pair arithmetic are in single precision.
            assert np.abs(difference).max() < 1e-4 * np.abs(values).max(), column
    comm.Barrier()


@pytest.mark.mpi(3)
def test_a_few_particles_go_on(comm, tmp_path, monkeypatch):
    """One rank has a single one of these eight particles."""
    keys = ["seed=3", "training.batch=8", "simulation.method=none", "simulation.step=0.03", "simulation.turnovers=0.1"]
    scene = prepared(comm, tmp_path, "incompressible", '[model]\nterms = ["pressure", "viscosity"]', side=2,
                     overrides=[*keys, "training.combined_steps=0", "training.field_weight=0"],
                     removals=["kernel", "training.horizons"])
    states = check_splits(comm, scene, tmp_path, monkeypatch)
    assert states[0]["rows_of_ranks"].sum() == 8 and 1 in states[0]["rows_of_ranks"]


class Standing:
    """Particles at rest, in steps of 0.1."""

    def __init__(self):
        self.time = 0.0

    def advance(self, until, number):
        self.time += 0.1

    def frame(self, time):
        return SimpleNamespace(velocity=torch.zeros(1, 3), to_numpy=dict), torch.zeros(1, 3)

    def status(self):
        return ""

    def state_dict(self):
        return {"time": self.time}

    def load_state_dict(self, saved):
        self.time = saved["time"]


class Still(Course):
    """Records times and steps of the frames."""

    def _store(self, at):
        self.times.append(at)
        self.stored = [*getattr(self, "stored", []), self.steps]


def course_of(comm, directory, looks=10**9, method=Standing, count=4, interval=0.25):
    guard = Guard(comm, directory, "settings", StopAtStep(comm, looks))
    segments = SimpleNamespace(comm=comm, names=[], close=lambda: None)
    return Still(method(), segments, count, interval, guard, guard.checkpoints.newest())


@pytest.mark.mpi(1)
def test_each_part_of_a_run_has_a_warm_up_that_is_not_timed(comm, tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(ProgressLine, "__call__", lambda self, done, step: shown.append(step))
    whole = course_of(comm, tmp_path / "whole")
    outcome = whole.run()
    assert outcome["status"] == "complete" and outcome["steps"] == 10 and len(whole.timed.rows) == 8
    assert whole.times == [0, 0.25, 0.5, 0.75, 1] and whole.stored == [0, 3, 5, 8, 10]
    assert shown == [*range(1, 11)]  # also after steps between frames
    first = course_of(comm, tmp_path / "parts", 5)
    with pytest.raises(Stopped, match="from step 5"):
        first.run()
    second = course_of(comm, tmp_path / "parts")
    assert second.progress.done == pytest.approx(0.5) and len(first.timed.rows) == 3
    assert second.timed.rows == [list(row) for row in first.timed.rows]
    assert second.run()["steps"] == 10 and len(second.timed.rows) == 3 + 3
    assert second.times == whole.times and second.stored == [8, 10]


class Falling(Standing):
    """Particles whose first step fails."""

    def advance(self, until, number):
        return "fell"


@pytest.mark.mpi(2)
def test_times_are_those_of_timed_steps_on_the_same_ranks(comm, tmp_path):
    """The first two steps are a warm-up. A step that fails has neither a time nor a length."""
    alone, place = comm.Split(comm.rank), tmp_path / f"rank-{comm.rank}"
    timed = {"seconds_per_step", "seconds_per_step_low", "seconds_per_step_high", "surplus_load", "switches_per_step"}
    found = [course_of(alone, place, count=1, interval=interval).run() for interval in (0.25, 0.2)]
    assert [outcome["steps"] for outcome in found] == [3, 2]
    assert timed < found[0].keys() and not timed & found[1].keys() and found[1]["time_step"] == pytest.approx(0.1)
    fallen = course_of(alone, place, method=Falling).run()
    assert fallen == {"status": "stopped: fell", "time": 0.0, "steps": 0}
    with pytest.raises(Stopped):
        course_of(comm, tmp_path / "run", 5).run()
    if comm.rank == 0:
        course = course_of(alone, tmp_path / "run")
        assert course.steps == 5 and course.timed.rows == []
    comm.Barrier()


class Carried(Standing):
    """Particles in reverse order, not on the ranks of their slabs, some outside the box."""

    def __init__(self, comm, total, density):
        super().__init__()
        ids = np.arange(total)[::-1]
        own = ids[ids % comm.size == comm.rank]
        self.columns = {"id": own, "position": own[:, None] + np.array([0.5, 7.0, -1.0]),
                        "velocity": own[:, None] * np.ones(3)} | ({"density": 2.0 + own} if density else {})

    def frame(self, time):
        return ParticleSet.from_numpy(self.columns), torch.full((len(self.columns["id"]), 3), time)


@pytest.mark.mpi(1, 3)
def test_a_frame_holds_the_particles_of_the_method_in_order_of_id(comm, tmp_path):
    total, length, density = 7, 2 * np.pi, comm.size == 3
    guard = Guard(comm, tmp_path / "checkpoints", "settings", StopAtStep(comm, 10**9))
    with FrameSegments(comm, tmp_path / "checkpoints", frame_layout(total, length, density)) as segments:
        course = Course(Carried(comm, total, density), segments, 2, 0.1, guard, None)
        course.run()
        with create_product(comm, tmp_path / "rollout.h5", "rollout", {}) as file:
            segments.assemble(file)
    assert course.energy == pytest.approx(1.5 * np.var(np.arange(total)))  # without the mean
    with open_product(comm, tmp_path / "rollout.h5", "rollout") as file:
        assert list(file["particles"]) == ["model"] and "fields" not in file
        stored, ids = Trajectory(file, "model"), np.arange(total)
        assert set(stored.columns) == {"position", "image", "velocity", "acceleration"} | (
            {"density"} if density else set())
        assert stored.times == pytest.approx([0, 0.1, 0.2])
        assert stored.read(0, "position") == pytest.approx((ids[:, None] + [0.5, 7.0, -1.0]) % length, abs=1e-6)
        assert np.array_equal(stored.read(2, "velocity"), ids[:, None] * np.ones(3))
        assert stored.read(2, "acceleration") == pytest.approx(np.full((total, 3), 0.2))
        assert not density or stored.read(1, "density").tolist() == (2.0 + ids).tolist()
