"""A small scene with variants from end to end, and the plan of its steps."""

import csv
import json
import os
from contextlib import nullcontext

import numpy as np
import pytest

import eddies
from eddies import stages
from eddies.io.errors import ProductError
from eddies.io.weights import load_weights
from eddies.scene.scene import load_scene
from eddies.workflows import product_warnings, simulate
from eddies.workflows.rollout.measured import open_rollout
from eddies.workflows.variants import rollouts, steps
from tests.commands import first_rank, run_cli
from tests.small_scene import TINY

SMALLER = ["flow.cells=16", "flow.viscosity=0.1", "spin_up.turnovers=0.3", "tracers.particles_per_side=8",
           "tracers.field_cells=12", "tracers.frame_interval=0.1", "tracers.field_every=1", "kernel.neighbors=30",
           "kernel.steps=4", "training.frames=3", "training.steps=6", "training.combined_steps=2", "training.batch=64",
           "simulation.step=0.05", "simulation.frame_interval=0.2", "simulation.turnovers=0.25"]
VARIANTS = """
[variant.learned]
[variant.longer-steps]
simulation.step = 0.1
[variant.no-force]
simulation.method = "none"
[variant.stops]
simulation.method = "none"
simulation.injection = 1e5
"""
UNSEEN = """
[variant.learned]
[variant.longer-steps]
simulation.step = 0.1
[variant.grid]
simulation.method = "eulerian"
eulerian.cells = 16
"""


@pytest.fixture
def folder(comm, tmp_path, monkeypatch):
    """The working directory, with a base scene and two scenes with variants."""
    if comm.rank == 0:
        (tmp_path / "base.toml").write_text(load_scene(TINY, [*SMALLER, "name=base"]).to_toml())
        (tmp_path / "small.toml").write_text('base = "base.toml"\ntitle = "small"\n' + VARIANTS)
        (tmp_path / "unseen.toml").write_text('base = "base.toml"\nrealisations = [5, 6]\n' + UNSEEN)
    comm.Barrier()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def rows_of(output):
    record = json.loads((output / "report/metrics.json").read_text())
    with open(output / "report/variants.csv", newline="") as file:
        assert [row["name"] for row in csv.DictReader(file)] == [row["name"] for row in record["rows"]]
    return record, {row["name"]: row for row in record["rows"]}


def planned(scene, stages, names=()):
    return [(str(step.directory), step.stages, {stage: str(holder) for stage, holder in step.links.items()})
            for step in steps(scene, stages, scene.directory, names)]


@pytest.mark.mpi(1)
def test_steps_of_a_scene(folder):
    plain, small, unseen = (load_scene(f"{name}.toml") for name in ("base", "small", "unseen"))
    every = ("dns", "train-kernel", "train", "simulate", "report")
    assert planned(plain, every) == [("runs/base", every[:-1], {})]
    shared = {"dns": "runs/small", "train-kernel": "runs/small"}
    assert planned(small, every) == [
        ("runs/small", ("dns", "train-kernel"), {}), ("runs/small/learned", ("train",), shared),
        ("runs/small/learned", ("simulate",), shared),
        ("runs/small/longer-steps", ("simulate",), {**shared, "train": "runs/small/learned"}),
        ("runs/small/no-force", ("simulate",), shared), ("runs/small/stops", ("simulate",), shared)]
    assert planned(small, ("train",), ["longer-steps"]) == [("runs/small/longer-steps", ("train",), shared)]
    where = [(str(directory), stages) for directory, stages, _ in planned(unseen, every)]
    assert where == [
        ("runs/unseen", ("dns", "train-kernel")), ("runs/unseen/realisation-5", ("dns", "train-kernel")),
        ("runs/unseen/realisation-6", ("dns", "train-kernel")), ("runs/unseen/learned", ("train",)),
        ("runs/unseen/longer-steps", ("train",)),  # finds the link to the model
        ("runs/unseen/learned/realisation-5", ("train", "simulate")),
        ("runs/unseen/longer-steps/realisation-5", ("train", "simulate")),
        ("runs/unseen/grid/realisation-5", ("simulate",)),
        ("runs/unseen/learned/realisation-6", ("train", "simulate")),
        ("runs/unseen/longer-steps/realisation-6", ("train", "simulate")),
        ("runs/unseen/grid/realisation-6", ("simulate",))]
    links = {directory: links for directory, _, links in planned(unseen, every)}
    assert links["runs/unseen/longer-steps"]["train"] == "runs/unseen/learned"


@pytest.mark.mpi(1)
def test_a_step_is_confirmed_on_all_realisations_of_the_same_flow(folder):
    (folder / "steps.toml").write_text('base = "base.toml"\nrealisations = [5, 6]\nsimulation.step = "converged"\n'
                                       "[variant.own]\n[variant.other]\nflow.viscosity = 0.2\n")
    scene = load_scene("steps.toml")
    named = {str(step.directory): step.scene.simulation.confirmed_on
             for step in steps(scene, scene.stages_of_all, scene.directory)}
    assert named["runs/steps/own"] == ("runs/steps/realisation-5", "runs/steps/realisation-6")
    assert named["runs/steps/other"] is None and named["runs/steps/own/realisation-5"] is None
    given = load_scene("steps.toml", ["model.path=eddies:tiny"])  # the search needs the weights, too
    stages = {where: stages for where, stages, _ in planned(given, given.stages_of_all)}
    assert stages["runs/steps/own"] == ("train", "find-step")


@pytest.mark.mpi(1)
def test_products_with_weights_of_a_file_are_not_shared_and_stages_of_one_variant_are_run(folder):
    """An earlier step may replace the file, so that equal settings do not mean equal weights."""
    (folder / "weights.toml").write_text('base = "base.toml"\nmodel.path = "."\n[variant.a]\n[variant.b]\n')
    (folder / "model.h5").write_text("weights of before")
    made = [links for _, stages, links in planned(load_scene("weights.toml"), ("train", "simulate"))
            if "simulate" in stages]
    assert [sorted(links) for links in made] == [["dns", "train-kernel"]] * 2
    (folder / "mixed.toml").write_text('base = "base.toml"\nsimulation.method = "none"\n[variant.free]\n'
                                       '[variant.learned]\nsimulation.method = "learned"\n')
    scene = load_scene("mixed.toml")
    assert "train" not in scene.stages
    assert ("runs/mixed/learned", ("train",)) in [step[:2] for step in planned(scene, scene.stages_of_all)]


@pytest.mark.mpi(2)
@pytest.mark.parametrize("command, message", [
    (["train", "small.toml", "--variant", "no-force"], 'no-force: [simulation] method = "none"'),
    (["simulate", "small.toml"], "out/ground_truth.h5: no such file"),
    (["run", "small.toml", "--variant", "no-forces"], "did you mean no-force?"),
    (["run", "unseen.toml", "--set", 'variant.learned.training.truths=["out/realisation-5"]', "--set",
      "simulation.start=0.5", "--set", "variant.grid.training.truths=none"],
     "learned: [training] truths names out/realisation-5/ground_truth.h5")],
    ids=["no such stage", "no ground truth", "no such variant", "trained on a realisation"])
def test_what_cannot_be_run_is_refused_before_any_work(comm, folder, capfd, command, message):
    assert run_cli(*command, "--output", "out") == 2
    assert comm.rank > 0 or message in capfd.readouterr().err
    assert not (folder / "out").exists()


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("variant, broken", [("learned", False), ("learned", True), (None, False)])
def test_an_error_ends_the_job_if_it_concerns_all_variants(comm, tmp_path, monkeypatch, variant, broken):
    """It does if HDF5 could not write a file, which the last rank alone knows, or in what all variants share."""
    monkeypatch.setattr(stages, "writing_failed", lambda: broken and comm.rank == comm.size - 1)
    failures = {}
    ends = variant is None or broken
    with pytest.raises(ProductError, match="no such reactor") if ends else nullcontext():
        with stages.recording_failure(failures, variant, tmp_path, comm):
            raise ProductError("no such reactor")
    assert failures == ({} if ends else {"learned": "no such reactor"})
    assert (tmp_path / "failure.txt").exists() != ends


@pytest.mark.mpi(1, timeout=300)
@pytest.mark.usefixtures("unmeasured")
def test_a_variant_in_another_flow_makes_its_own_ground_truth(folder):
    """It replaces the link to the shared ground truth."""
    text = 'base = "base.toml"\nunset = ["kernel"]\nsimulation.method = "none"\ntraining.combined_steps = 0\n'
    text += "training.field_weight = 0\ntraining.velocity_kl_weight = 0\ntraining.acceleration_kl_weight = 0\n"
    (folder / "own.toml").write_text(text + "[variant.a]\n[variant.b]\n")
    assert run_cli("simulate", "own.toml") == 2
    for stage in ("dns", "simulate"):
        assert run_cli(stage, "own.toml") == 0
    truths = [folder / "runs/own" / where / "ground_truth.h5" for where in ("", "a", "b")]
    shared = truths[0].read_bytes()
    (folder / "own.toml").write_text(text + "[variant.a]\n[variant.b]\nflow.viscosity = 0.2\n")
    scene = load_scene("own.toml")
    assert [own.flow.viscosity for runs in rollouts(scene, folder).values() for own in runs.values()] == [0.1, 0.2]
    assert planned(scene, ("dns", "simulate"))[1] == ("runs/own/b", ("dns",), {})
    assert run_cli("dns", "own.toml") == 0
    assert run_cli("simulate", "own.toml", "--overwrite") == 0
    assert [path.is_symlink() for path in truths] == [False, True, False]
    assert truths[0].read_bytes() == shared != truths[2].read_bytes()


@pytest.mark.mpi(2, timeout=300)
@pytest.mark.usefixtures("no_figures")
def test_variants_are_run_measured_and_kept(comm, folder, capfd, monkeypatch):
    """One that fails does not end the others, and is run again."""
    out, whole = folder / "out", simulate.run

    def failing(scene, *rest):
        if scene.name == "longer-steps":
            raise eddies.SceneError("no such thing")
        whole(scene, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(simulate, "run", failing)
        assert run_cli("run", "small.toml", "--output", "out") == 2
    assert comm.rank > 0 or "variants failed: longer-steps (no such thing)" in capfd.readouterr().err
    comm.Barrier()
    rows = rows_of(out)[1]
    assert rows["longer-steps"]["status"] == "failed: no such thing" and rows["no-force"]["status"] == "complete"
    before = {path: path.stat().st_mtime_ns for path in out.glob("*/*.h5")}
    capfd.readouterr()
    first_rank(comm, (out / "no-force/rollout.h5").unlink)
    assert run_cli("run", "small.toml", "--set", "variant.learned.simulation.step=0.04", "--output", "out") == 2
    assert comm.rank > 0 or "(simulation.step = 0.05, now 0.04)" in capfd.readouterr().err
    assert run_cli("run", "small.toml", "--output", "out") == 0
    comm.Barrier()
    assert {str(path.relative_to(out)) for path, time in before.items() if path.stat().st_mtime_ns != time} == {
        "no-force/rollout.h5", "no-force/measures.h5"}
    record, again = rows_of(out)
    assert again["learned"]["velocity_error_early"] == rows["learned"]["velocity_error_early"]
    check_rows(again)
    assert record["machine"]["ranks"] == 2 and record["machine"]["cores"] >= 1 and record["machine"]["processor"]
    assert 0 < record["flow"]["kolmogorov_length"] < record["flow"]["filter_width"]
    for name in again:
        assert (out / name / "kernel.h5").resolve() == out / "kernel.h5" and (out / name / "scene.toml").exists()
        assert (out / name / "measures.h5").exists() and not (out / name / "report").exists()
    assert (out / "longer-steps/model.h5").resolve() == out / "learned/model.h5"
    assert not (out / "no-force/model.h5").exists()
    assert record["rollouts"]["no-force"]["energy_ratio"] == pytest.approx(again["no-force"]["energy_ratio"], rel=1e-6)


def check_rows(rows):
    learned, longer, none, stops = (rows[name] for name in ("learned", "longer-steps", "no-force", "stops"))
    assert {row["status"] for row in (learned, longer, none)} == {"complete"}
    assert stops["status"].startswith("stopped: step 1") and stops["stopped_at"] == 0
    assert stops["velocity_kl"] is stops["wall_seconds"] is None
    for row in (learned, longer, none):
        # The particles start with the true velocity.
        assert 0 < row["velocity_error_early"] < 0.5 and 0.5 < row["energy_ratio"] < 2
        assert row["wall_seconds_low"] <= row["wall_seconds"] <= row["wall_seconds_high"]
        assert row["core_seconds"] == pytest.approx(2 * row["wall_seconds"])
        # Floors are those of the true particles, which are the same for all.
        assert row["spectrum_error_floor"] == learned["spectrum_error_floor"] < row["spectrum_error"]
        assert row["velocity_kl_floor"] == learned["velocity_kl_floor"] and row["tetrad_size_error"] > 0
    assert none["acceleration_error"] == 1 and none["training_seconds"] is None
    assert learned["training_seconds"] == longer["training_seconds"] > 0
    assert (learned["time_step"], longer["time_step"]) == (pytest.approx(0.05), pytest.approx(0.1))


@pytest.mark.mpi(1, timeout=300)
@pytest.mark.usefixtures("no_figures", "quick_solves", "quick_spectra")
def test_realisations_that_no_training_has_seen(comm, folder, monkeypatch):
    """One training and a rollout on each realisation. The table has mean and standard deviation of both. Each product
    is searched once for numbers that are not finite."""
    scanned = []
    with monkeypatch.context() as patch:
        patch.setattr(product_warnings, "stored_numbers", lambda file: scanned.append(file.filename) or ())
        assert run_cli("run", "unseen.toml", "--output", "out") == 0
    read = [os.path.realpath(path) for path in scanned]
    assert len(set(read)) == len(read) > 0
    out = folder / "out"
    assert sorted(str(path.relative_to(out)) for path in out.glob("**/model.h5")) == [
        f"{name}/{where}model.h5" for name in ("learned", "longer-steps")
        for where in ("", "realisation-5/", "realisation-6/")]
    assert (out / "longer-steps/model.h5").resolve() == out / "learned/model.h5"
    assert not (out / "learned/rollout.h5").exists()
    weights = [load_weights(comm, path, "model").weights for path in out.glob("**/model.h5")]
    assert all(np.array_equal(one[name], values) for one in weights for name, values in weights[0].items())
    record, rows = rows_of(out)
    (summary,) = (sentence for sentence in record["summary"] if "the velocity error of" in sentence)
    page = (out / "report/index.html").read_text()
    assert summary in page and "5 in grid" in page and "seeds 5, 6" in page and rows["grid"]["method"] == "eulerian"
    assert record["simulation_seconds"] == rows["grid"]["wall_seconds"]  # it has the grid of the direct simulation
    assert rows["learned"]["training_seconds"] > 0 and rows["grid"]["training_seconds"] is None
    for name, row in rows.items():
        assert row["realisations"] == 2 and row["status"] == "complete"
        both = []
        for seed in (5, 6):
            with open_rollout(out / name / f"realisation-{seed}", comm) as rollout:
                pair = rollout.rollout.pair(-1, "velocity")
                # The start is the first frame with a filtered field.
                assert rollout.rollout.start_time == pytest.approx(0.1)
                both.append(pair.model.astype(float).var(axis=0).sum() / pair.truth.astype(float).var(axis=0).sum())
        assert row["energy_ratio"] == pytest.approx(np.mean(both), rel=1e-6)
        assert row["energy_ratio_spread"] == pytest.approx(abs(both[0] - both[1]) / 2**0.5, rel=1e-4)
        assert both[0] != both[1]
    first_rank(comm, out.rename, folder / "moved")
    assert run_cli("simulate", "unseen.toml", "--output", "moved") == 0  # no work of other settings
