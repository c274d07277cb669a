"""A training that is stopped and continued equals the one that was never stopped."""

import sys
from dataclasses import replace
from itertools import pairwise

import h5py
import matplotlib
import numpy as np
import pytest

from eddies import stages
from eddies.parallel.stop import Stopped, StopRequest
from eddies.scene.scene import SceneError, load_scene
from eddies.workflows import dns, train, train_kernel
from eddies.workflows.run_directory.work import stage_seconds
from tests.small_scene import TINY
from tests.workflows.contents import assert_same, numbers_in
from tests.workflows.stopping import StopAtStep

# Ten frame intervals, all for training. Six steps on single frames, two of them with all losses; then two steps through
# each horizon.
SHORT = ["flow.cells=12", "tracers.particles_per_side=6", "tracers.field_cells=8", "spin_up.turnovers=0.01",
         "tracers.turnovers=0.14", "tracers.frame_interval=0.02", "tracers.field_every=3", "kernel.neighbors=20",
         "kernel.steps=3", "kernel.points=20", "model.pairs.hidden=[4]", "training.window=1", "training.frames=2",
         "training.batch=50", "training.steps=6", "training.combined_steps=2", "simulation.start=0",
         "training.horizons.steps=2", "training.horizons.frames=[1,2]"]

# Only equality matters here, not the quality of the model.
pytestmark = pytest.mark.usefixtures("quick_solves", "no_figures")


@pytest.fixture(scope="module")
def products(comm, shared_folder):
    """The short scene, and a folder with its ground truth and kernel."""
    scene, folder = load_scene(TINY, SHORT), shared_folder()
    dns.run(scene, comm, folder)
    train_kernel.run(scene, comm, folder)
    return scene, folder


def check_same_after_stops(comm, run, scene, directory, product, stops):
    """Stop a training at some steps, then let it end: the product is the one that was never stopped."""
    run(scene, comm, directory)
    whole, others = numbers_in(comm, directory / product), {path.name for path in directory.iterdir()}
    for before, step in pairwise((0, *stops)):
        with pytest.raises(Stopped, match=f"from step {step} of the training"):
            run(scene, comm, directory, StopAtStep(comm, step - before))
    run(scene, comm, directory)
    assert_same(numbers_in(comm, directory / product), whole)
    assert {path.name for path in directory.iterdir()} == others
    return whole


@pytest.mark.mpi(2)
def test_a_stopped_training_is_the_one_never_stopped(comm, products, linked):
    """Within the first phase, between two phases, and between two horizons."""
    scene, folder = products
    directory = linked(folder)
    whole = check_same_after_stops(comm, train.run, scene, directory, "model.h5", (3, 6, 8))
    assert np.array_equal(whole["history/phase"], [0] * 4 + [1] * 2 + [2] * 2 + [3] * 2)
    with h5py.File(directory / "model.h5") as file:
        assert np.all(np.diff(file["history/seconds"][()]) > 0)
    assert (directory / "learning.png").read_bytes().startswith(b"\x89PNG\r\n\x1a\n")


@pytest.mark.mpi(2)
def test_a_stopped_training_of_the_kernel_is_the_one_never_stopped(comm, products, linked):
    """Before the first step, between the two forms of the kernel, and before the last step."""
    scene, folder = products
    directory = linked(folder / "ground_truth.h5")
    whole = check_same_after_stops(comm, train_kernel.run, scene, directory, "kernel.h5", (0, 3, 5))
    assert len(whole["history/loss_learned"]) == len(whole["history/loss_learned_no_gradient"]) == 3


@pytest.mark.mpi(1)
def test_a_kernel_that_diverges_is_an_error_with_the_remedy(comm, products, linked):
    scene, folder = products
    wild = replace(scene, kernel=replace(scene.kernel, learning_rate=1e15))
    with pytest.raises(SceneError, match=r"\[kernel\] step .*learned.*lower learning_rate"):
        train_kernel.run(wild, comm, linked(folder / "ground_truth.h5"))


@pytest.mark.mpi(2)
def test_a_training_is_not_lost_to_a_picture(comm, products, linked, monkeypatch, caplog):
    scene, folder = products
    scene, directory = replace(scene, training=replace(scene.training, horizons=None)), linked(folder)
    monkeypatch.setattr(train, "DRAWING_SECONDS", -1.0)  # draw after each step, too
    for fault in ("backend", "exit", "no matplotlib", "directory"):
        with monkeypatch.context() as patch:
            if fault == "directory":
                (directory / "learning.png").mkdir(exist_ok=True)
            elif fault == "no matplotlib":
                patch.setitem(sys.modules, "eddies.report.learning", None)
            else:
                png = sys.exit if fault == "exit" else lambda figure: matplotlib.use("nonsense")
                patch.setattr("eddies.report.figures.png", png)
            caplog.clear()
            train.run(scene, comm, directory)
        warnings = [record for record in caplog.records if "cannot draw" in record.getMessage()]
        assert len(warnings) == (comm.rank == 0), fault
        comm.Barrier()
        assert (directory / "model.h5").exists()
        comm.Barrier()
        if comm.rank == 0:
            (directory / "model.h5").unlink()
        comm.Barrier()


@pytest.mark.mpi(2)
def test_a_training_continues_with_inputs_of_the_same_settings(comm, products, linked):
    scene, folder = products
    directory = linked(folder)

    def stopped(looks, step, names=("train",)):
        with pytest.raises(Stopped, match=f"from step {step} of the training"):
            stages.run_stages(names, scene, comm, directory, StopAtStep(comm, looks))

    # One look is before the stage begins.
    stopped(3, 2)
    first = stage_seconds(directory)["train"]
    stopped(2, 3)
    assert stage_seconds(directory)["train"] > first > 0
    if comm.rank == 0:
        (directory / "kernel.h5").unlink()
    # The two forms of the kernel are trained again, three steps each, with the same settings and the same result.
    stopped(1 + 2 * 3 + 2, 4, names=("train-kernel", "train"))
    leftover = directory / "checkpoints-train"
    for _ in range(2):
        stages.run_stages(["train"], scene, comm, directory, StopRequest(comm))
        assert not leftover.exists()
        comm.Barrier()
        if comm.rank == 0:
            leftover.mkdir()
        comm.Barrier()
