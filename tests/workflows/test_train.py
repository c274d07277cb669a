"""Trainings: stopped and continued as if never stopped; on several ranks with ghosts and sums of gradients, which are
counted; and the test a priori."""

import sys
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import h5py
import matplotlib
import numpy as np
import pytest
from mpi4py import MPI

from eddies import stages
from eddies.kernels.pairs import CompiledPairs, Summand
from eddies.kernels.reconstruction import kernel_numbers
from eddies.learning import training
from eddies.parallel.stop import StopRequest, Stopped
from eddies.particles import pairs
from eddies.scene.scene import SceneError, load_scene
from eddies.workflows import dns, train, train_kernel
from eddies.workflows.ground_truth.truth import open_truth
from eddies.workflows.run_directory.work import stage_seconds
from eddies.workflows.train import _given_rate_error
from tests.commands import first_rank
from tests.small_scene import TINY
from tests.workflows.contents import assert_same, numbers_in
from tests.workflows.stopping import StopAtStep
from tests.workflows.synthetic_run import write_ground_truth

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
        first_rank(comm, (directory / "model.h5").unlink)


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
        first_rank(comm, leftover.mkdir)


SMALL = ["flow.cells=16", "flow.viscosity=0.1", "spin_up.turnovers=0.05", "tracers.turnovers=0.9",
         "tracers.particles_per_side=10", "tracers.field_cells=16", "tracers.frame_interval=0.1",
         "tracers.field_every=1", "kernel.neighbors=20", "training.frames=2", "training.batch=64", "training.steps=3",
         "training.combined_steps=0", "training.field_weight=0", "training.velocity_kl_weight=0",
         "training.acceleration_kl_weight=0"]


def neighbours(space, receivers, particles):
    """How many pairs of receivers with other particles there are within the radius, in the periodic box."""
    away = np.abs(receivers[:, None] - particles[None]) % space.length
    square = (np.minimum(away, space.length - away) ** 2).sum(2)
    return int(np.count_nonzero(square < space.radius**2)) - len(receivers)  # without each with itself


@pytest.mark.mpi(3)
def test_training_evaluates_pairs_with_ghosts_and_sums_gradients(comm, tmp_path, monkeypatch):
    assert load_scene("hit-small").variant["paper"].model == load_scene("hit-small").model  # what is trained here
    scene = load_scene("hit-small", SMALL, ["variant"])
    evaluated, summed = [], []

    class Counted(CompiledPairs):
        def __init__(self, space, position, velocity, scalars, wanted, kind):
            super().__init__(space, position, velocity, scalars, wanted, kind)
            self.given = space, position, wanted

        def gradients(self, summands, parameters, by_sums, columns):
            space, position, wanted = self.given
            # A kernel that is 1 within the radius counts them.
            one = Summand("kernel-sum", kernel_numbers(space.radius, np.ones((1, 1))), (1.0,))
            found = self.sums([one], [np.empty(0)])[0]
            evaluated.append(([each.kind for each in summands], space, position, wanted, float(found[0, wanted].sum())))
            return super().gradients(summands, parameters, by_sums, columns)

    def sum_flat(where, arrays):
        own = [array.copy() for array in arrays]
        added(where, arrays)
        summed.append((own, [array.copy() for array in arrays]))

    added = training.sum_flat
    monkeypatch.setattr(pairs, "CompiledPairs", Counted)
    monkeypatch.setattr(training, "sum_flat", sum_flat)
    dns.run(scene, comm, tmp_path)
    train.run(scene, comm, tmp_path)

    assert len(evaluated) == len(summed) == 3
    total, thickness = scene.tracers.particles, 2 * np.pi / comm.size
    for kinds, space, position, wanted, counted in evaluated:
        assert kinds.count("pair-network") == 2 and "eddy-viscosity" in kinds  # of force and density, and Pi
        ghosts = int(np.count_nonzero((position[:, 2] < comm.rank * thickness)
                                      | (position[:, 2] >= (comm.rank + 1) * thickness)))
        assert (ghosts > 0) == (comm.size > 1)
        own = comm.allgather(position[(position[:, 2] // thickness).astype(int) == comm.rank])
        particles = np.concatenate(own)
        assert len(particles) == total
        receivers = np.concatenate(comm.allgather(position[wanted]))
        assert len(receivers) == scene.training.batch
        assert comm.allreduce(counted) == neighbours(space, receivers, particles) > 0
        if comm.size > 1:  # without ghosts some pairs are missing
            assert comm.allreduce(neighbours(space, position[wanted], own[comm.rank])) < comm.allreduce(counted)
    for own, after in summed:
        assert sum(map(np.size, own)) > 2500  # the weights of both networks, and four coefficients
        everywhere = comm.allgather(own)
        for number, values in enumerate(after):
            np.testing.assert_allclose(values, sum(each[number] for each in everywhere), rtol=1e-5, atol=1e-7)
        assert all(np.abs(each[0]).max() > 0 for each in everywhere)  # every rank has a part in the first layer


@pytest.mark.mpi(2)
def test_a_density_equal_to_the_true_one_changes_at_the_true_rate(comm, tmp_path):
    first_rank(comm, write_ground_truth, MPI.COMM_SELF, tmp_path, frames=5)
    exact = SimpleNamespace(model=SimpleNamespace(integrates_density=True),
                            rates=lambda particles: SimpleNamespace(density=particles.density))
    with open_truth(comm, tmp_path / "ground_truth.h5") as truth:
        assert _given_rate_error(truth, exact, 2) < 1e-12
