"""Training on the ground truths of other runs, alone and together, forced and unforced."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from mpi4py import MPI

from eddies.io.provenance import product_attributes, product_provenance
from eddies.io.weights import load_weights
from eddies.parallel.reduction import global_sum
from eddies.particles.exchanges import relative_error
from eddies.particles.flow_units import planes_for
from eddies.particles.model import FORCING
from eddies.scene.scene import load_scene
from eddies.workflows import dns, train
from eddies.workflows.estimates import most_ranks
from eddies.workflows.ground_truth.frame_counts import last_seen, rollout_start
from eddies.workflows.learned.source import ModelDefinition
from eddies.workflows.learned.training_data import load_frame, model_for, open_truths, training_data, truth_problems
from eddies.workflows.problems import problems, rank_problems
from eddies.workflows.rollout.method import forcing_of, make_method
from eddies.workflows.variants import steps
from tests.commands import first_rank
from tests.changed_product import changed
from tests.workflows.small_rollout import with_method

pytestmark = pytest.mark.usefixtures("no_figures")
CPU = torch.device("cpu")
SCENE = """
[flow]
fluid = "compressible"
cells = 12
viscosity = 0.1
sound_speed = 15.0
[initial]
peak_wavenumber = 2
[forcing]
injection_rate = 1.0
[spin_up]
turnovers = 0.1
[tracers]
particles_per_side = 6
turnovers = 0.2
frame_interval = 0.02
field_every = 1
field_cells = 12
[model]
terms = ["pressure", "stress", "viscosity", "damping", "relaxation"]
[training]
frames = 4
batch = 100
steps = 6
combined_steps = 2
acceleration_kl_weight = 0.1
precision = "float64"
[training.horizons]
steps = 2
frames = [1]
[simulation]
step = 0.1
turnovers = 0.05
frame_interval = 0.02
"""


def scene_of(directory, *overrides):
    return load_scene(directory / "own.toml", overrides)


def made(comm, directory, *overrides, runs=("own",)):
    """A scene, and ground truths in run directories below `directory`, each with its own seed."""
    first_rank(comm, (directory / "own.toml").write_text, SCENE)
    for seed, name in enumerate(runs, 1):
        (directory / name).mkdir(exist_ok=True)
        dns.run(scene_of(directory, *overrides, f"seed={seed}"), comm, directory / name)
    return scene_of(directory, *overrides)


def opened(scene, comm, directory):
    return open_truths(directory / "ground_truth.h5", scene.training.truth_files, comm, CPU)


def trained_on(scene, *directories):
    return replace(scene, training=replace(scene.training, truths=tuple(map(str, directories))))


def weights_and_errors(scene, comm, directory):
    train.run(scene, comm, directory)
    stored = load_weights(comm, directory / "model.h5", "model")
    return stored.weights, stored.tables


def copied(source, target):
    """Copy the ground truth of a run into another run directory."""
    target.mkdir()
    return shutil.copy(source / "ground_truth.h5", target)


@pytest.mark.mpi(2)
def test_training_on_two_flows_takes_the_same_steps_on_any_number_of_ranks(comm, tmp_path, quick_solves):
    scene = trained_on(made(comm, tmp_path, runs=("one", "two")), tmp_path / "one", tmp_path / "two")
    weights, tables = weights_and_errors(scene, comm, tmp_path / "one")
    if comm.rank == 0:
        copied(tmp_path / "one", tmp_path / "alone")
        scene = trained_on(scene, tmp_path / "alone", tmp_path / "two")
        expected, expected_tables = weights_and_errors(scene, MPI.COMM_SELF, tmp_path / "alone")
        for name, tensor in expected.items():
            assert np.abs(weights[name] - tensor).max() < 1e-9 * np.abs(tensor).max()
        for name in ("loss", "validation_error"):
            assert np.allclose(tables["history"][name], expected_tables["history"][name], rtol=1e-9, equal_nan=True)
        # The flows take turns, and each phase is validated on both.
        assert len(tables["history"]["loss"]) == 6 + 2


@pytest.mark.mpi(1)
def test_naming_the_own_ground_truth_changes_nothing(comm, tmp_path, quick_solves):
    scene = made(comm, tmp_path, "tracers.forced=true")
    found = [weights_and_errors(each, comm, tmp_path / "own")
             for each in (scene, trained_on(scene, tmp_path / "own" / "ground_truth.h5"))]
    (weights, tables), (expected, expected_tables) = found
    assert all(np.array_equal(weights[name], expected[name]) for name in expected)
    for name, columns in expected_tables.items():
        assert all(np.array_equal(tables[name][column], values, equal_nan=True)
                   for column, values in columns.items() if column != "seconds")


def twice_as_fast(source, target):
    """The same flow in a unit of time that is twice as long."""
    powers = {"velocity_rms": 1, "acceleration_rms": 2, "sound_speed": 1, "viscosity": 1, "density_rate_rms": 1}
    with changed(copied(source, target)) as file:
        file.attrs["provenance"] = json.dumps(json.loads(file.attrs["provenance"]) | {"id": "another"})
        reference, tracers = file["reference"].attrs, file["particles/tracers"]
        for name, power in powers.items():
            reference[name] *= 2.0**power
        tracers["velocity/value"][...] *= 2
        tracers["position/time"][...] /= 2  # shared by all columns
        file["fields/filtered/velocity"][...] *= 2


@pytest.mark.mpi(1)
def test_the_same_is_learned_of_the_same_flow_in_other_units(comm, tmp_path, quick_solves):
    """A model sees each flow in the scales of that flow."""
    scene = made(comm, tmp_path, "training.steps=4", "training.combined_steps=0", "training.acceleration_kl_weight=0",
                 "simulation.start=0.1")
    scene = replace(scene, training=replace(scene.training, horizons=None, window=1.0))
    own = tmp_path / "own"
    expected, seen = weights_and_errors(scene, comm, own)
    twice_as_fast(own, tmp_path / "fast")
    weights, unseen = weights_and_errors(trained_on(scene, tmp_path / "fast"), comm, own)
    for name, tensor in expected.items():
        assert np.allclose(weights[name], tensor, rtol=1e-9)
    assert np.allclose(unseen["history"]["loss"], seen["history"]["loss"], rtol=1e-9)
    assert np.allclose(unseen["a_priori"]["acceleration_error"], seen["a_priori"]["acceleration_error"], rtol=1e-9)
    # Weights of another run keep the name of the flow of their training.
    train.run(replace(scene, model=replace(scene.model, path=str(own))), comm, tmp_path / "fast")
    source = product_provenance(tmp_path / "fast/model.h5")["source"]
    (truth, mach), = source["truths"].items()
    assert truth == str(tmp_path / "fast/ground_truth.h5") and source["path"] == str(own)
    assert mach == product_attributes(truth, "reference")["mach_turbulent"] > 0
    # The filtered pressure gradient is a part of the acceleration, a small one in so viscous a flow.
    assert 0 < seen["a_priori"]["pressure_gradient_error"].max() < 1
    # The delay is that since the end of the training window, here the whole flow or nothing of it.
    assert seen["a_priori"]["delay"].max() < 0 < unseen["a_priori"]["delay"].min()


@pytest.mark.mpi(1)
def test_a_forced_truth_is_matched_only_with_its_forcing(comm, tmp_path):
    """Known forces, none of which is learned, match the truth if the forcing has the power in its file."""
    scene = made(comm, tmp_path, "tracers.forced=true", "tracers.particles_per_side=10",
                 'model.terms=["pressure", "stress", "viscosity"]')
    with opened(scene, comm, tmp_path / "own") as (truth, _):
        assert (truth.forcing.injection_rate, truth.forcing.wavenumber) == (1.0, 2.0)
        models = [model_for(ModelDefinition.of(scene), truth, torch.float64)]
        truth.forcing = None
        models.append(model_for(ModelDefinition.of(scene), truth, torch.float64))
        frames = [load_frame(truth, 4, model, torch.float64) for model in models]
        force = frames[0].kept[FORCING].at(None).acceleration
        missed = [frame.errors()["acceleration"] for frame in frames]
        with_it, without = (relative_error(comm, error, force) for error in missed)
        share = global_sum(comm, float((-missed[1] * force).sum())) / global_sum(comm, float(force.square().sum()))
    # The rest of the error is a third of the force and uncorrelated with it.
    assert with_it < 0.4 * without and share == pytest.approx(1, abs=0.02)


@pytest.mark.mpi(1)
def test_flows_have_their_own_forcing_and_share_the_parameters(comm, tmp_path, quick_solves):
    free = made(comm, tmp_path)
    forced = scene_of(tmp_path, "tracers.forced=true", "forcing.injection_rate=0.7", "seed=4")
    (tmp_path / "forced").mkdir()
    dns.run(forced, comm, tmp_path / "forced")
    scene = trained_on(free, tmp_path / "own", tmp_path / "forced")
    with opened(scene, comm, tmp_path / "own") as (own, truths):
        assert truths[0] is own
        first, second = training_data(ModelDefinition.of(scene), scene.training, truths)
        assert FORCING not in first.model.terms
        assert second.model.terms[FORCING].settings.injection_rate == 0.7
        assert first.model.flow.scales == truths[0].scales != second.model.flow.scales == truths[1].scales
        assert list(map(id, first.model.parameters())) == list(map(id, second.model.parameters()))
        assert len(first.frames) == len(second.frames) == 2


@pytest.mark.mpi(1)
def test_a_rollout_is_forced_like_its_truth_and_starts_after_the_training_window(comm, tmp_path):
    scene = made(comm, tmp_path, "tracers.forced=true")
    other = tmp_path / "other"
    copied(tmp_path / "own", other)
    with opened(scene, comm, tmp_path / "own") as (truth, _):
        for power, rate in (("truth", 1.0), ("none", None), ("dissipation", truth.reference["dissipation_rate"]),
                            (0.3, 0.3)):
            forcing = forcing_of(power, scene.forcing, truth)
            assert (forcing and forcing.injection_rate) == rate
        ends = last_seen(scene.training.window, len(truth.times))
        coarse = make_method(with_method(scene, "eulerian"), None, truth, ends, tmp_path)
        assert coarse.fluid.forcing.injection_rate == 1.0 and coarse.fluid.forcing.wavenumber == 2.0
        # Each frame has a field. The first frame has no rates.
        for each, start in ((scene, ends), (trained_on(scene, other), 1)):
            seen = each.seen_in(tmp_path / "own")
            assert rollout_start(each.simulation, each.tracers, seen, len(truth.times), truth.field_frames) == start
        assert ends > 2


def halve_times(file):
    file["particles/tracers/position/time"][...] /= 2


# Changes of the scene, a change of the other ground truth, and what is said of it.
REFUSED = {
    "another filter": ([], lambda file: file["reference"].attrs.modify("filter_width", 1.2),
                       "its filter is 1.14591559 mean spacings wide"),
    "no density": (['model={preset = "paper"}'], lambda file: file["particles/tracers"].pop("density"),
                   "holds no density"),
    "other frames": ([], halve_times, "its frames are 0.01 apart"),
    "fewer particles": (["tracers.particles_per_side=7", "training.batch=300"], None, "holds 216 particles"),
    "too short": (["training.window=0.05", "simulation.start=0.5"], None, "[training] window = 0.05: holds 2 frames"),
    "no tracers": ([], lambda file: file["particles"].pop("tracers"), "holds no tracers"),
}


@pytest.mark.mpi(1)
def test_unfit_truths_are_refused_before_any_work(comm, tmp_path):
    made(comm, tmp_path)

    def problem_with(scene, *others):
        """The problem with another ground truth. The run makes its own, which [training] truths names too."""
        own = tmp_path / "new"
        scene = trained_on(scene, own, *others)
        refused, _ = problems(scene, steps(scene, ("train",), own), comm)
        assert any(problem.startswith("own: [training] truths: ") for problem in refused)
        found, = truth_problems(scene.training, scene.tracers, scene.model.reads, own / "ground_truth.h5", comm)
        assert found.startswith(f'[training] truths: "{others[-1]}"')
        return found

    assert "nowhere/ground_truth.h5: no such file" in problem_with(scene_of(tmp_path), tmp_path / "nowhere")
    more_frames = scene_of(tmp_path, "training.frames=6")
    assert "is named twice" in problem_with(more_frames, tmp_path / "own", tmp_path / "own")
    for case, (overrides, change, message) in REFUSED.items():
        copied(tmp_path / "own", tmp_path / case)
        with changed(tmp_path / case / "ground_truth.h5") as file:
            if change is not None:
                change(file)
        assert message in problem_with(scene_of(tmp_path, *overrides), tmp_path / case), case


@pytest.mark.mpi(1)
def test_another_truth_limits_the_number_of_ranks(comm, tmp_path):
    """It has 8 planes, the own one 14. Slabs must hold the radius of interaction, 2.5 planes."""
    other = made(comm, tmp_path, "tracers.particles_per_side=4", "training.batch=60", runs=("other",))
    assert planes_for(other.tracers.particles) == 8
    place = f'[training] truths: "{tmp_path / "other"}"'
    for model, most, reason in (('{terms=["viscosity"]}', 2, "ghost planes of the resolved velocity"),
                                ('{preset="paper", neighbors=8}', 2,
                                 "slabs, at least as thick as the particles' reach 1.95")):
        alone = scene_of(tmp_path, "tracers.particles_per_side=8", f"model={model}")
        alone = replace(alone, training=replace(alone.training, horizons=None))
        scene = trained_on(alone, tmp_path / "nowhere", tmp_path / "other")
        limits = most_ranks(scene)
        assert not [*rank_problems(most_ranks(alone), 3), *rank_problems(limits, most)]
        problem, = rank_problems(limits, 3)
        assert f"({place}: {reason}" in problem and f"at most {most}" in problem
        # The own ground truth, and weights of another run, allow more ranks.
        taken = replace(scene, model=replace(scene.model, path="runs/other"))
        assert not [*rank_problems(most_ranks(scene.ground_truth_alone), 3), *rank_problems(most_ranks(taken), 3)]
