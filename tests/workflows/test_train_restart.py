"""A training that is stopped and continued equals the one that was never stopped."""

import sys
from dataclasses import replace
from itertools import pairwise

import h5py
import matplotlib
import numpy as np
import pytest

from eddies import stages
from eddies.io.hdf5 import open_product, read_table
from eddies.io.weights import load_weights
from eddies.parallel.stop import Stopped, StopRequest
from eddies.scene.scene import SceneError, load_scene
from eddies.workflows import dns, train, train_kernel
from eddies.workflows.run_directory.work import stage_seconds
from tests.small_scene import TINY
from tests.workflows.stopping import StopAtStep

# Ten frame intervals, all for training. Six steps on single frames, two of them with all losses; then, if there are
# horizons, two of each.
SHORT = ["flow.cells=12", "tracers.particles_per_side=6", "tracers.field_cells=8", "spin_up.turnovers=0.01",
         "tracers.turnovers=0.14", "tracers.frame_interval=0.02", "tracers.field_every=3", "kernel.neighbors=20",
         "kernel.steps=2", "kernel.points=20", "model.pairs.hidden=[4]", "training.window=1", "training.frames=2",
         "training.batch=50", "training.steps=6", "training.combined_steps=2", "simulation.start=0"]
THROUGH_HORIZONS = [*SHORT, "training.horizons.steps=2", "training.horizons.frames=[1,2]"]


# Only equality matters here, not the quality of the model.
pytestmark = pytest.mark.usefixtures("quick_solves", "no_figures")


def prepared(comm, directory, settings=THROUGH_HORIZONS):
    """A directory with the ground truth and the kernel of the short scene."""
    scene = load_scene(TINY, settings)
    if comm.rank == 0:
        directory.mkdir(parents=True, exist_ok=True)
    comm.Barrier()
    dns.run(scene, comm, directory)
    train_kernel.run(scene, comm, directory)
    return scene


def datasets(comm, path):
    """All datasets of a file by name."""
    comm.Barrier()
    found = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: item[()]} if isinstance(item, h5py.Dataset) else {}))
    comm.Barrier()
    return found


def trained(comm, directory):
    """Weights, learning history and a-priori errors."""
    numbers = load_weights(comm, directory / "model.h5", "model")[1]
    with open_product(comm, directory / "model.h5", "model") as file:
        for table in ("history", "a_priori"):
            numbers |= {f"{table}/{name}": values for name, values in read_table(file, table).items()}
    return numbers


@pytest.mark.mpi(2)
def test_a_stopped_training_is_the_one_never_stopped(comm, tmp_path):
    scene = prepared(comm, tmp_path)
    train.run(scene, comm, tmp_path)
    whole = trained(comm, tmp_path)
    assert np.array_equal(whole["history/phase"], [0] * 4 + [1] * 2 + [2] * 2 + [3] * 2)
    comm.Barrier()
    if comm.rank == 0:
        (tmp_path / "learning.png").unlink()
    # Before the first step, within the first phase, between two phases, and between two horizons.
    for before, step in pairwise((0, 0, 3, 6, 8)):
        with pytest.raises(Stopped, match=f"from step {step} of the training"):
            train.run(scene, comm, tmp_path, StopAtStep(comm, step - before))
    train.run(scene, comm, tmp_path)
    parts = trained(comm, tmp_path)
    assert parts.keys() == whole.keys()
    assert np.all(np.diff(parts.pop("history/seconds")) > 0)
    for name, values in parts.items():
        assert np.array_equal(values, whole[name], equal_nan=True), name
    comm.Barrier()
    assert (tmp_path / "learning.png").read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    assert {path.name for path in tmp_path.iterdir()} == {"ground_truth.h5", "kernel.h5", "model.h5", "learning.png"}


@pytest.mark.mpi(1, 3)
def test_a_stopped_training_of_the_kernel_is_the_one_never_stopped(comm, tmp_path):
    scene = prepared(comm, tmp_path, [*SHORT, "tracers.particles_per_side=9", "kernel.steps=3"])
    whole = datasets(comm, tmp_path / "kernel.h5")
    assert len(whole["history/loss_learned"]) == len(whole["history/loss_learned_no_gradient"]) == 3
    # Before the first step, within a form of the kernel, between the two, and before the last step.
    for before, step in pairwise((0, 0, 1, 3, 5)):
        with pytest.raises(Stopped, match=f"from step {step} of the training"):
            train_kernel.run(scene, comm, tmp_path, StopAtStep(comm, step - before))
    train_kernel.run(scene, comm, tmp_path)
    parts = datasets(comm, tmp_path / "kernel.h5")
    assert parts.keys() == whole.keys()
    for name, values in parts.items():
        assert np.array_equal(values, whole[name]), name
    comm.Barrier()
    assert {path.name for path in tmp_path.iterdir()} == {"ground_truth.h5", "kernel.h5"}


@pytest.mark.mpi(1)
def test_a_kernel_that_diverges_is_an_error_with_the_remedy(comm, tmp_path):
    scene = prepared(comm, tmp_path, SHORT)
    wild = replace(scene, kernel=replace(scene.kernel, learning_rate=1e15, steps=4))
    with pytest.raises(SceneError, match=r"\[kernel\] step .*learned.*lower learning_rate"):
        train_kernel.run(wild, comm, tmp_path)


@pytest.mark.mpi(1, 2)
def test_a_training_is_not_lost_to_a_picture(comm, tmp_path, monkeypatch, caplog):
    scene = prepared(comm, tmp_path)
    monkeypatch.setattr(train, "DRAWING_SECONDS", -1.0)  # draw after each step, too
    for fault in ("backend", "exit", "no matplotlib", "directory"):
        with monkeypatch.context() as patch:
            if fault == "directory":
                (tmp_path / "learning.png").mkdir(exist_ok=True)
            elif fault == "no matplotlib":
                patch.setitem(sys.modules, "eddies.report.learning", None)
            else:
                png = sys.exit if fault == "exit" else lambda figure: matplotlib.use("nonsense")
                patch.setattr("eddies.report.figures.png", png)
            caplog.clear()
            train.run(scene, comm, tmp_path)
        warnings = [record for record in caplog.records if "cannot draw" in record.getMessage()]
        assert len(warnings) == (comm.rank == 0), fault
        assert trained(comm, tmp_path)


@pytest.mark.mpi(2)
def test_a_training_continues_with_inputs_of_the_same_settings(comm, tmp_path):
    scene = prepared(comm, tmp_path, SHORT)

    def stopped(looks, step, names=("train",)):
        with pytest.raises(Stopped, match=f"from step {step} of the training"):
            stages.run_stages(names, scene, comm, tmp_path, StopAtStep(comm, looks))

    # One look is before the stage begins.
    stopped(3, 2)
    first = stage_seconds(tmp_path)["train"]
    stopped(2, 3)
    assert stage_seconds(tmp_path)["train"] > first > 0
    if comm.rank == 0:
        (tmp_path / "kernel.h5").unlink()
    # The two forms of the kernel are trained again, two steps each, with the same settings and the same result.
    stopped(1 + 2 * 2 + 2, 4, names=("train-kernel", "train"))
    stages.run_stages(["train"], scene, comm, tmp_path, StopRequest(comm))
    leftover = tmp_path / "checkpoints-train"
    assert not leftover.exists()
    comm.Barrier()
    if comm.rank == 0:
        leftover.mkdir()
    comm.Barrier()
    stages.run_stages(["train"], scene, comm, tmp_path, StopRequest(comm))
    assert not leftover.exists()


@pytest.mark.mpi(2)
def test_a_window_too_short_for_its_horizons_is_refused(comm, tmp_path):
    prepared(comm, tmp_path)
    scene = load_scene(TINY, [*SHORT, "training.horizons.steps=1", "training.horizons.frames=[1,5]"])
    with pytest.raises(SceneError, match=r"\[training\] window = 1: holds 10 frames .* 5 held out .* horizons of 5"):
        train.run(scene, comm, tmp_path)
    assert not list(tmp_path.glob("model.h5*"))
