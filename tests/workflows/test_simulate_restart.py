"""A rollout that is stopped and continued equals the one that was never stopped."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from eddies.io.checkpoint import Checkpoint
from eddies.parallel.stop import Stopped
from eddies.scene.scene import BOX_LENGTH, Eulerian, Model
from eddies.workflows import simulate
from tests.workflows.contents import assert_same, numbers_in
from tests.workflows.small_rollout import OWN_METHOD, prepared, scales_of, with_method, write_model
from tests.workflows.stopping import StopAtStep

pytestmark = pytest.mark.usefixtures("quick_spectra", "quick_solves")

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
    if comm.rank == 0:
        checkpoints.rename(saved)
    comm.Barrier()
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
    if comm.rank == 0:
        (directory / "rollout.h5").unlink()
    comm.Barrier()
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


@pytest.mark.mpi(1)
def test_a_method_without_a_state_begins_again(comm, small_products, linked, own):
    scene, folder = small_products
    directory = linked(folder)
    own("own_restarting", OWN_METHOD)
    scene = with_method(scene, "own_restarting:Swept")
    with pytest.raises(Stopped, match="after the last finished stage"):
        simulate.run(scene, comm, directory, StopAtStep(comm, 1))
    simulate.run(scene, comm, directory)
    assert product(comm, directory)["rollout/status"] == "complete"
    assert not (directory / "checkpoints-rollout").exists()


@pytest.mark.mpi(3)
def test_a_few_particles_go_on(comm, tmp_path, monkeypatch):
    """One rank has a single one of these eight particles."""
    keys = ["seed=3", "training.batch=8", "simulation.method=none", "simulation.step=0.03", "simulation.turnovers=0.1"]
    scene = prepared(comm, tmp_path, "incompressible", '[model]\nterms = ["pressure", "viscosity"]', side=2,
                     overrides=[*keys, "training.combined_steps=0", "training.field_weight=0"],
                     removals=["kernel", "training.horizons"])
    states = check_splits(comm, scene, tmp_path, monkeypatch)
    assert states[0]["rows_of_ranks"].sum() == 8 and 1 in states[0]["rows_of_ranks"]
