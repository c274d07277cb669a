"""A rollout that is stopped and continued equals the one that was never stopped."""

import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from eddies.io.checkpoint import Checkpoint
from eddies.parallel.stop import Stopped
from eddies.scene.scene import BOX_LENGTH, Eulerian, Model, load_scene
from eddies.workflows import dns, simulate
from tests.workflows.small_rollout import OWN_METHOD, prepared, scales_of, with_method, write_model
from tests.workflows.stopping import StopAtStep

pytestmark = pytest.mark.usefixtures("quick_spectra")

MODELS = {
    "default": Model(preset="resolved + pairs"),
    "density inputs": Model(preset="resolved + pairs", settings={"pairs": {
        "inputs": ("density", "distance", "speed", "approach")}}),
    "own density": Model(terms=("pairs", "density-flux", "continuity"), settings={"continuity": {"diffusion": 0.1}}),
    "local": Model(preset="local"),
}
# Number of inputs of all networks.
FEATURES = {"default": 3, "density inputs": 5, "own density": 10, "local": 0}
DENSITY = {"step": 0.015, "turnovers": 0.06}
# Frames are 0.04 apart. Steps of 0.03 go beyond them; with other integrators frames are at the ends of steps.
CASES = {
    "default": ("default", "learned", {"step": 0.03, "skin": 0.3}),
    "density inputs, forced, Verlet": ("density inputs", "learned", {
        "step": 0.02, "injection": "dissipation", "integrator": "verlet", "skin": 0.3}),
    "own density": ("own density", "learned", {**DENSITY, "precision": "float64"}),
    "own density, forced, Verlet": ("own density", "learned", {
        **DENSITY, "step": 0.02, "injection": 0.5, "integrator": "verlet"}),
    "local": ("local", "learned", {"step": 0.03}),
    "eulerian": (None, "eulerian", {"step": 0.02}, {"fluid": "compressible"}),
    "eulerian, forced": (None, "eulerian", {"step": 0.02, "injection": 1.0}, {"closure": "dynamic-smagorinsky"}),
    "none": (None, "none", {"step": 0.015}),
}


@pytest.fixture(scope="module")
def products(comm):
    """A directory with a ground truth, a kernel, and each of the models; the same on all ranks, and its scene."""
    folder = Path(comm.bcast(tempfile.mkdtemp() if comm.rank == 0 else None))
    scene = prepared(comm, folder / "run", side=9, overrides=["tracers.field_cells=12"])  # enough for three slabs
    scales = scales_of(comm, folder / "run", 9)
    for name, model in MODELS.items():
        if comm.rank == 0:
            (folder / name).mkdir()
        comm.Barrier()
        write_model(comm, folder / name, replace(scene, model=model), scales, 0.5, FEATURES[name])
    comm.Barrier()
    yield folder, scene
    comm.Barrier()
    if comm.rank == 0:
        shutil.rmtree(folder)


@pytest.fixture
def case_of(comm, products, tmp_path):
    """Scene and a directory with the products it starts from, of a case by name."""
    folder, scene = products

    def case(name):
        model, method, keys, *form = CASES[name]
        if comm.rank == 0:
            for path in (folder / "run/ground_truth.h5", folder / "run/kernel.h5", folder / f"{model}/model.h5"):
                if path.exists():
                    (tmp_path / path.name).symlink_to(path)
        comm.Barrier()
        simulation = replace(scene.simulation, method=method, **{"turnovers": 0.11, **keys})
        coarse = {"eulerian": Eulerian(cells=12, **form[0])} if method == "eulerian" else {}
        return replace(scene, model=MODELS.get(model, scene.model), simulation=simulation, **coarse), tmp_path

    return case


def product(comm, directory):
    """All numbers of a rollout that another run must repeat: datasets, and attributes but for wall times."""
    comm.Barrier()
    found = {}
    with h5py.File(directory / "rollout.h5") as file:
        file.visititems(lambda name, item: found.update({name: item[()]} if isinstance(item, h5py.Dataset) else {}))
        found["frames at steps"] = file["particles/model/step"][()]  # of which there are several links
        found |= {name: value for name, value in file["rollout"].attrs.items()
                  if "seconds" not in name and name != "storing_share"}
    comm.Barrier()
    return found


def assert_same(found, expected, place):
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        assert np.array_equal(found[name], values), (place, name)


def each_step_saved(comm, scene, directory, monkeypatch):
    """Run with a checkpoint before each step, and keep them all."""
    monkeypatch.setattr("eddies.io.checkpoint.KEPT", 100)
    with monkeypatch.context() as patch:
        patch.setattr("eddies.io.checkpoint.CheckpointDirectory.remove", lambda self: None)
        simulate.run(scene, comm, directory, StopAtStep(comm, every_step=True))
    comm.Barrier()
    saved = directory / "saved"
    if comm.rank == 0:
        (directory / "checkpoints-rollout").rename(saved)
    comm.Barrier()
    return saved


def go_on_from(comm, scene, directory, saved, step):
    """Take up a run at one of its checkpoints."""
    comm.Barrier()
    if comm.rank == 0:
        checkpoints = directory / "checkpoints-rollout"
        checkpoints.mkdir()
        for path in saved.glob("frames-*.h5"):
            shutil.copy(path, checkpoints)
        shutil.copy(saved / f"step-{step:08d}.h5", checkpoints)
        (directory / "rollout.h5").unlink()
    comm.Barrier()
    simulate.run(scene, comm, directory)


@pytest.mark.usefixtures("quick_solves")
@pytest.mark.mpi(1)
@pytest.mark.parametrize("name", CASES)
def test_every_split_of_a_rollout_is_the_whole_rollout(comm, case_of, monkeypatch, name):
    check_splits(comm, *case_of(name), monkeypatch)


@pytest.mark.usefixtures("quick_solves")
@pytest.mark.mpi(2, 3)
@pytest.mark.parametrize("name", ["density inputs, forced, Verlet", "own density", "eulerian, forced"])
def test_splits_on_several_ranks(comm, case_of, monkeypatch, name):
    check_splits(comm, *case_of(name), monkeypatch, each=comm.size)


def check_splits(comm, scene, directory, monkeypatch, each=1):
    """Continue from each, or each second, ... of these: the first step, the second, one after a frame, the last."""
    simulate.run(scene, comm, directory)
    whole = product(comm, directory)
    assert whole["status"] == "complete" and len(whole["frames at steps"]) >= 2
    saved = each_step_saved(comm, scene, directory, monkeypatch)
    assert_same(product(comm, directory), whole, "with checkpoints")
    steps = int(whole["steps"])
    assert len(list(saved.glob("step-*"))) == steps >= 3
    at_frames = sorted(set(whole["frames at steps"].tolist()))
    for split in sorted({0, 1, at_frames[1], steps - 1} - {steps})[each - 1::each]:
        go_on_from(comm, scene, directory, saved, split)
        assert_same(product(comm, directory), whole, split)
    assert not (directory / "checkpoints-rollout").exists()


@pytest.mark.mpi(2)
def test_a_list_that_was_built_before_is_kept(comm, case_of, monkeypatch):
    """A list that is built at the present positions would change the order of sums over pairs."""
    scene, directory = case_of("own density")
    saved = each_step_saved(comm, scene, directory, monkeypatch)
    states = [Checkpoint(path) for path in sorted(saved.glob("step-*"))]
    moved = [(state["particles built at"] != state["particles position"]).any() for state in states
             if "built at" in state["columns"]]
    assert any(moved)


@pytest.mark.mpi(1, 2)
def test_a_stopped_rollout_continues_and_leaves_nothing_else(comm, case_of):
    scene, directory = case_of("default")
    names = {path.name for path in directory.iterdir()}
    for number in (1, 2):
        with pytest.raises(Stopped, match=f"from step {number} of the rollout"):
            simulate.run(scene, comm, directory, StopAtStep(comm, 1))
    comm.Barrier()
    assert {path.name for path in directory.iterdir()} == names | {"checkpoints-rollout"}
    comm.Barrier()
    simulate.run(scene, comm, directory)
    comm.Barrier()
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
        assert other["steps"] == whole["steps"]
        for column in ("position", "velocity", "acceleration"):
            values = whole[f"particles/model/{column}/value"]
            difference = other[f"particles/model/{column}/value"] - values
            if column == "position":
                difference -= BOX_LENGTH * np.rint(difference / BOX_LENGTH)
            # Frames and pair arithmetic are in single precision, and solves end at their tolerance.
            assert np.abs(difference).max() < 1e-4 * np.abs(values).max(), column
    comm.Barrier()


@pytest.mark.mpi(1, 2)
def test_a_method_without_a_state_begins_again(comm, products, tmp_path, own):
    if comm.rank == 0:
        own("own_restarting", OWN_METHOD)
        for name in ("ground_truth.h5", "kernel.h5"):
            (tmp_path / name).symlink_to(products[0] / "run" / name)
    comm.Barrier()
    scene = with_method(products[1], "own_restarting:Swept")
    with pytest.raises(Stopped, match="after the last finished stage"):
        simulate.run(scene, comm, tmp_path, StopAtStep(comm, 1))
    simulate.run(scene, comm, tmp_path)
    assert product(comm, tmp_path)["status"] == "complete"
    assert not (tmp_path / "checkpoints-rollout").exists()


FEW = """
seed = 3
[flow]
fluid = "incompressible"
cells = 16
viscosity = 0.1
[tracers]
particles_per_side = 2
turnovers = 0.14
frame_interval = 0.02
field_every = 1
field_cells = 8
[model]
terms = ["pressure", "viscosity"]
[training]
window = 1
frames = 2
batch = 8
steps = 2
[simulation]
method = "none"
step = 0.03
turnovers = 0.1
frame_interval = 0.04
start = 0.3
"""


@pytest.mark.mpi(3)
def test_a_few_particles_go_on(comm, tmp_path, monkeypatch):
    """One rank has a single one of these eight particles."""
    if comm.rank == 0:
        (tmp_path / "own.toml").write_text(FEW)
    comm.Barrier()
    scene = load_scene(tmp_path / "own.toml")
    dns.run(scene, comm, tmp_path)
    check_splits(comm, scene, tmp_path, monkeypatch)
    rows = Checkpoint(tmp_path / "saved/step-00000000.h5")["rows_of_ranks"]
    assert rows.sum() == 8 and 1 in rows
