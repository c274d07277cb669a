"""The tiny scene from DNS to report through the command line, on two ranks."""

import dataclasses
import json
import math
import re
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from eddies.io.new_files import python_value
from eddies.io.weights import load_weights
from eddies.learning.training import shared_values
from eddies.scene.model import BUILT_IN_PREFIX, WEIGHTS, built_in_weights
from eddies.scene.scene import load_scene
from eddies.stored_run import open_run
from eddies.workflows.diff import numbers_of
from eddies.workflows.ground_truth.truth import open_truth
from eddies.workflows.learned.source import ModelDefinition
from eddies.workflows.learned.training_data import training_data
from eddies.workflows.report import NOT_COMPARABLE
from tests.commands import first_rank, run_cli
from tests.left_out import leave_out_figures
from tests.small_scene import TINY

pytestmark = pytest.mark.mpi(2, timeout=240)
CHANGES = ["kernel.steps=20", "training.steps=30"]
SCENE = [TINY, *(word for change in CHANGES for word in ("--set", change))]


def numbers(metrics):
    for value in metrics.values():
        if isinstance(value, dict):
            yield from numbers(value)
        elif isinstance(value, (int, float)) and not isinstance(value, bool):
            yield value


@pytest.fixture(scope="module")
def run_directory(comm, shared_folder):
    """One run for all tests of this module."""
    directory = shared_folder() / "tiny"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("eddies.report.figures.png", lambda figure: b"")
        leave_out_figures(patch)
        patch.setattr("eddies.workflows.rollout.particle_measures.MOST_ITERATIONS", 3)
        assert run_cli("run", *SCENE, "--output", directory) == 0
    comm.Barrier()
    return directory


def test_metrics_are_finite_and_within_bounds(run_directory):
    metrics = numbers_of(run_directory, None)
    assert all(math.isfinite(value) for value in numbers(metrics))
    truth, kernel, model, rollout = (metrics[key] for key in ("ground_truth", "kernel", "models", "rollouts"))
    assert truth["energy_budget_error"] < 2e-3 and truth["kmax_eta"] > 0.9 and 0.05 < truth["mach_turbulent"] < 0.12
    assert kernel["integral"] == pytest.approx(1, abs=1e-5)
    # After thirty steps the error is below that without a model, which is 1.
    assert model["acceleration_error"] < 0.9
    assert rollout["stable"] and 0.5 < rollout["energy_ratio"] < 1.5
    assert rollout["closure_not_converged"] == 0 and 0.3 < rollout["closure_iterations"] < 10
    # Three in each of nine steps, and one at the start.
    assert rollout["evaluations_per_turnover"] == pytest.approx(28 / rollout["turnovers"])
    assert rollout["velocity_error"] < 0.95 * error_of_frozen_velocities(run_directory)
    with h5py.File(run_directory / "ground_truth.h5") as file:
        end, turnover = file["statistics/time"][-1], file["reference"].attrs["eddy_turnover_time"]
        steps = file["particles/tracers/density/step"][-1]
    per_step, per_turnover = (metrics["cost"][f"dns_seconds_per_{word}"] for word in ("step", "turnover"))
    assert per_turnover / per_step == pytest.approx(steps * turnover / end)


def test_every_dataset_says_its_axes_and_units(run_directory):
    for product in run_directory.glob("*.h5"):
        with h5py.File(product) as file:
            file.visititems(lambda path, found: check_words(path, found) if isinstance(found, h5py.Dataset) else None)


def check_words(path, dataset):
    """A dataset has a name for each axis, and units unless it has pure numbers."""
    units, axes = (python_value(dataset.attrs.get(name, "")) for name in ("units", "axes"))
    where, name = f"{dataset.file.filename}, {path}", path.split("/")[-2 if path.endswith("/value") else -1]
    assert path.startswith("weights/") or len(axes.split()) == dataset.ndim, where
    expected = {"time": "T", "velocity": "L/T", "energy": "L^2/T^2", "seconds": "s", "kmax_eta": "", "id": ""}
    assert units == expected.get(name, units), where


def test_what_check_foresees_is_what_was_run(run_directory):
    from eddies.workflows.estimates import estimate
    from eddies.workflows.ground_truth.frame_counts import unfiltered_frames
    from eddies.workflows.estimates import rollout_bytes, storage, trajectory_bytes
    scene = load_scene(TINY, CHANGES)
    with h5py.File(run_directory / "rollout.h5") as file:
        stored = len(file["particles/model/time"])
    with h5py.File(run_directory / "ground_truth.h5") as file:
        frames, measured = len(file["particles/tracers/time"]), file["reference"].attrs["mach_turbulent"]
    assert estimate(scene).mach == pytest.approx(measured, rel=0.5)
    whole = len(unfiltered_frames(scene.simulation, scene.training, scene.tracers.field_every, frames))
    sizes = {"ground_truth": trajectory_bytes(scene.flow, scene.tracers, frames, whole),
             "rollout": rollout_bytes(scene.tracers.particles, stored),
             "kernel": storage(scene, "train-kernel", 1).kept, "model": storage(scene, "train", 1).kept}
    for name, size in sizes.items():
        assert (run_directory / f"{name}.h5").stat().st_size == pytest.approx(size, rel=0.2), name


def error_of_frozen_velocities(directory):
    """Velocity error at the last common frame of particles that keep their first velocity."""
    velocity = open_run(directory).trajectories(of="truth")["velocity"].values
    return np.linalg.norm(velocity[0] - velocity[-1]) / np.linalg.norm(velocity[-1])


def test_pairs_outside_the_training_data_are_counted(run_directory):
    with h5py.File(run_directory / "model.h5") as file:
        low, high = (file[f"feature_range/{bound}"][()] for bound in ("low", "high"))
        description = json.loads(file.attrs["description"])
    scene, length = load_scene(TINY, CHANGES), description["scales"]["filter_width"]
    support = scene.tracers.radius_of(scene.kernel.neighbors) / length
    # |x|, |v|, x.v
    assert low.shape == high.shape == (3,) and np.all(low < high)
    assert 0 < low[0] < 0.1 * support < 0.99 * support < high[0] <= support and 0 < low[1] and low[2] < 0 < high[2]
    with h5py.File(run_directory / "rollout.h5") as file:
        share = file["outside_training/share"][()]
        assert np.array_equal(file["outside_training/time"], file["particles/model/position/time"])
    # The particles start from the flow that the network was trained on, a little later.
    assert np.all((0 <= share) & (share < 0.01))
    assert numbers_of(run_directory, None)["rollouts"]["outside_training"] == share.max()


def test_weights_that_come_along_are_as_good_as_their_card_says(run_directory, linked, tmp_path):
    """On a flow that differs only by round-off from that of the training."""
    page = (Path(__file__).parents[2] / "docs/comparing.md").read_text()
    card = {name: float(error) for name, error in re.findall(r"^\| `(eddies:.+?)` \|.*\| ([\d.]+) \|$", page, re.M)}
    assert list(card) == built_in_weights()
    for name, error in card.items():
        with h5py.File(WEIGHTS / f"{name.removeprefix(BUILT_IN_PREFIX)}.h5") as file:
            assert f"{file['a_priori/acceleration_error'][-1]:.3f}" == f"{error:.3f}", name
    linked(run_directory / "ground_truth.h5", run_directory / "kernel.h5")
    assert run_cli("train", *SCENE, "--set", "model.preset=resolved", "--set", "model.path=eddies:tiny",
                   "--output", tmp_path) == 0
    with h5py.File(tmp_path / "model.h5") as file:
        assert file["a_priori/acceleration_error"][-1] == pytest.approx(card["eddies:tiny"], rel=0.02)
        assert file["source_a_priori/acceleration_error"][-1] == pytest.approx(card["eddies:tiny"], rel=0.01)


def doubts(metrics):
    """The warnings of a report, but those of a machine that is busy with other tests."""
    return [words for words in metrics["warnings"] if NOT_COMPARABLE not in words]


def test_products_say_what_they_were_made_from(run_directory):
    found = {}
    for name in ("ground_truth", "kernel", "model", "rollout"):
        with h5py.File(run_directory / f"{name}.h5") as file:
            found[name] = json.loads(file.attrs["provenance"])
    ids = {name: origin["id"] for name, origin in found.items()}
    assert len({*ids.values()}) == 4
    assert doubts(json.loads((run_directory / "report" / "metrics.json").read_text())) == []
    for number, origin in enumerate(found.values()):
        assert origin["made_from"] == dict(list(ids.items())[:number])


@pytest.mark.usefixtures("no_figures", "quick_spectra")
def test_what_fits_is_kept_and_what_changed_is_redone(comm, run_directory, capfd):
    before = {path: path.stat().st_mtime_ns for path in run_directory.glob("*.h5")}
    comm.Barrier()
    changed = ("run", *SCENE, "--output", run_directory, "--set", "simulation.turnovers=0.2")
    assert run_cli(*changed) == 2
    assert ("replaced: rollout.h5 (took " in capfd.readouterr().err) == (comm.rank == 0)
    assert run_cli(*changed, "--overwrite") == 0
    comm.Barrier()
    log = capfd.readouterr().out
    assert comm.rank > 0 or log.count("skipped") == 3 and "; complete\n" in log
    replaced = {path.name for path, time in before.items() if path.stat().st_mtime_ns != time}
    assert replaced == {"rollout.h5", "measures.h5"}


@pytest.mark.usefixtures("no_figures", "quick_spectra")
def test_a_trained_model_runs_on_another_flow(comm, run_directory, tmp_path):
    """At twice the Mach number, with the scales of that flow only."""
    slower = load_scene(TINY, ["flow.sound_speed=11", "seed=2", "spin_up.turnovers=0.5", "tracers.turnovers=0.25",
                               "kernel.steps=4", "simulation.turnovers=0.1", f"model.path={run_directory}"])
    first_rank(comm, (tmp_path / "slower.toml").write_text, dataclasses.replace(slower, training=None).to_toml())
    assert run_cli("run", tmp_path / "slower.toml", "--output", tmp_path / "run") == 0
    comm.Barrier()
    with h5py.File(run_directory / "model.h5") as trained, h5py.File(tmp_path / "run" / "model.h5") as adopted:
        for table in ("weights", "feature_range"):
            for name, values in trained[table].items():
                assert np.array_equal(adopted[table][name], values)
        scales = [json.loads(file.attrs["description"])["scales"] for file in (trained, adopted)]
        assert scales[0]["sound_speed"] == 22.5 and scales[1]["sound_speed"] == 11
        assert scales[1]["density"] > 2 * scales[0]["density"]
        assert adopted["a_priori/delay"][0] > 0
    with h5py.File(tmp_path / "run" / "rollout.h5") as file:
        rollout = dict(file["rollout"].attrs)
        assert rollout["start_time"] == pytest.approx(0.1) and python_value(rollout["status"]) == "complete"
    metrics = numbers_of(tmp_path / "run", None)
    shown = metrics["models"]
    assert doubts(metrics) == []
    assert shown["acceleration_error"] < 0.95 and shown["source_acceleration_error"] < 0.9
    assert shown["mach_turbulent"] == pytest.approx(2 * shown["source_mach_turbulent"], rel=0.2)


@pytest.mark.parametrize("preset, weights", [("paper", "hit-small-paper"), ("local", "hit-local"),
                                             ("resolved", "tiny")])
def test_the_losses_of_a_horizon_begin_within_a_factor_of_ten(comm, run_directory, preset, weights):
    """Those of the velocity and of the energies, for trained models: neither hides the other."""
    settings = ["training.horizons.frames=[2]", "training.horizons.steps=1", f"model.preset={preset}"]
    stored = load_weights(comm, WEIGHTS / f"{weights}.h5", "model")
    scene = load_scene("tiny", settings, ["variant"])
    with open_truth(comm, run_directory / "ground_truth.h5") as truth:
        [data] = training_data(ModelDefinition.of(scene), scene.training, [truth])
        data.model.load_state_dict({name: torch.as_tensor(values) for name, values in stored.weights.items()})
        trainer, window = data.rollout_trainer()
        with torch.no_grad():
            losses = shared_values(comm, trainer.loss_shares(window, 2))
    assert 0.1 < losses["energy_loss"] / losses["rollout_loss"] < 10
