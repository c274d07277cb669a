"""A comparison from end to end on a scene even smaller than tiny, and what it refuses before any work."""

import csv
import json
from types import SimpleNamespace

import numpy as np
import pytest

from eddies.io.errors import WriteError
from eddies.io.hdf5 import ProductError, open_product, read_attributes
from eddies.io.trajectories import Trajectory
from eddies.io.weights import load_weights
from eddies.report.page import Section
from eddies.scene.scene import SceneError, load_scene
from eddies.workflows import compare
from eddies.workflows.compare import check_ground_truth
from eddies.workflows.variants.run import VariantRun
from tests.workflows.synthetic_run import write_ground_truth

SMALLER = ["flow.cells=16", "flow.viscosity=0.1", "spin_up.turnovers=0.3", "tracers.particles_per_side=8",
           "tracers.field_cells=12", "tracers.frame_interval=0.1", "tracers.field_every=1", "kernel.neighbors=30",
           "kernel.steps=4", "training.steps=6", "training.combined_steps=2", "training.batch=64",
           "simulation.step=0.05", "simulation.frame_interval=0.2"]
FILE = """
title = "small"
base = "base.toml"
run = "base"
turnovers = 0.25
repeats = 2
set = ["training.frames=3"]
[[variant]]
name = "learned"
[[variant]]
name = "longer-steps"
set = ["simulation.step=0.1"]
[[variant]]
name = "no-force"
set = ["simulation.method=none"]
group = "baseline"
[[variant]]
name = "stops"
set = ["simulation.injection=1e5"]
group = "baseline"
"""


def run_cli(*arguments):
    from eddies.cli import main
    return main([str(argument) for argument in arguments])


@pytest.fixture
def folder(comm, tmp_path, monkeypatch):
    """A folder with a scene and a comparison, to work in."""
    if comm.rank == 0:
        (tmp_path / "base.toml").write_text(load_scene("tiny", [*SMALLER, "name=base"]).to_toml())
        (tmp_path / "small.toml").write_text(FILE)
    comm.Barrier()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def rows_of(output):
    record = json.loads((output / "comparison.json").read_text())
    with open(output / "comparison.csv", newline="") as file:
        table = list(csv.DictReader(file))
    assert [row["name"] for row in table] == [row["name"] for row in record["rows"]]
    return record, {row["name"]: row for row in record["rows"]}


@pytest.mark.mpi(2, timeout=240)
@pytest.mark.usefixtures("undrawn")
def test_variants_are_run_measured_and_kept(comm, folder, capfd):
    assert run_cli("dns", "base.toml", "--output", "base") == 0
    if comm.rank == 0:
        (folder / "out/figures").mkdir(parents=True)
        (folder / "out/figures/mine.png").write_text("precious")
    assert run_cli("compare", "small.toml", "--output", "out") == 0
    comm.Barrier()
    out = folder / "out"
    record, rows = rows_of(out)
    check_rows(rows)
    assert record["machine"]["ranks"] == 2 and record["machine"]["cores"] >= 1 and record["machine"]["processor"]
    assert 0 < record["flow"]["kolmogorov_length"] < record["flow"]["filter_width"]
    assert (out / "learned/kernel.h5").resolve() == (out / "no-force/kernel.h5").resolve()
    assert (out / "learned/model.h5").resolve() == (out / "longer-steps/model.h5").resolve()
    assert not (out / "no-force/model.h5").exists() and not list(out.glob("*/timing"))
    page = (out / "index.html").read_text()
    assert "stops (at 0 T): stopped: step 1" in page and "learned is worth its cost in" in page
    assert len(list((out / "figures").glob("*.png"))) == 5 + 1 and (out / "figures/mine.png").exists()
    capfd.readouterr()

    before = {path: path.stat().st_mtime_ns for path in out.glob("*/*.h5")}
    comm.Barrier()
    if comm.rank == 0:
        (out / "no-force/rollout.h5").unlink()
    comm.Barrier()
    if comm.rank == 0:
        (folder / "changed.toml").write_text(FILE.replace("simulation.step=0.1", "simulation.step=0.12"))
    comm.Barrier()
    assert run_cli("compare", "changed.toml", "--output", "out") == 2
    told = "longer-steps: holds work of other settings (simulation.step = 0.1, now 0.12) that would be replaced"
    assert comm.rank > 0 or told in capfd.readouterr().err
    comm.Barrier()
    assert {path: path.stat().st_mtime_ns for path in out.glob("*/*.h5")}.items() <= before.items()
    assert run_cli("compare", "small.toml", "--output", "out") == 0
    comm.Barrier()
    assert [str(path.relative_to(out)) for path, time in before.items() if path.stat().st_mtime_ns != time] == [
        "no-force/rollout.h5"]
    again = rows_of(out)[1]
    assert all(again[name]["velocity_error_early"] == rows[name]["velocity_error_early"] for name in rows)


def check_rows(rows):
    learned, longer, none, stops = (rows[name] for name in ("learned", "longer-steps", "no-force", "stops"))
    assert {row["status"] for row in (learned, longer, none)} == {"complete"}
    assert stops["status"].startswith("stopped: step 1") and stops["stopped_at"] == 0
    assert stops["velocity_kl"] is stops["wall_seconds"] is None
    for row in (learned, longer, none):
        # Of the velocity itself; the particles start from it.
        assert 0 < row["velocity_error_early"] < 0.5 and 0.5 < row["energy_ratio"] < 2
        assert row["wall_seconds_low"] <= row["wall_seconds"] <= row["wall_seconds_high"]
        assert row["core_seconds"] == pytest.approx(2 * row["wall_seconds"])
        # Of the particles that all are compared with.
        assert row["spectrum_error_floor"] == learned["spectrum_error_floor"] < row["spectrum_error"]
        assert row["velocity_kl_floor"] == learned["velocity_kl_floor"] and row["tetrad_size_error"] > 0
    assert none["acceleration_error"] == 1 and none["training_seconds"] is None
    assert learned["training_seconds"] == longer["training_seconds"] > 0
    assert (learned["time_step"], longer["time_step"]) == (pytest.approx(0.05), pytest.approx(0.1))


UNSEEN = FILE[:FILE.index("[[variant]]")].replace("repeats = 2", "repeats = 1\nrealisations = [5, 6]") + """
[[variant]]
name = "learned"
[[variant]]
name = "grid"
set = ["simulation.method=eulerian", "eulerian.cells=12"]
group = "baseline"
"""


@pytest.mark.mpi(1, timeout=240)
@pytest.mark.usefixtures("undrawn", "quick_spectra")
def test_realisations_that_no_training_has_seen(comm, folder, capfd):
    """One training, a rollout on each; mean and spread of two numbers are half of their sum and difference."""
    (folder / "small.toml").write_text(UNSEEN)
    assert run_cli("dns", "base.toml", "--output", "base") == 0
    capfd.readouterr()
    assert run_cli("compare", "small.toml", "--output", "out") == 2
    assert "make it with `eddies dns base.toml --set seed=5 --output base-seed-5`" in capfd.readouterr().err
    for seed in (5, 6):
        assert run_cli("dns", "base.toml", "--set", f"seed={seed}", "--output", f"base-seed-{seed}") == 0
    assert run_cli("compare", "small.toml", "--output", "out") == 0
    out = folder / "out"
    assert sorted(str(path.relative_to(out)) for path in out.glob("**/model.h5")) == [
        "learned/model.h5", "learned/seed-5/model.h5", "learned/seed-6/model.h5"]
    assert not (out / "learned/rollout.h5").exists() and not (out / "grid/seed-5/model.h5").exists()
    weights = [load_weights(comm, path, "model")[1] for path in out.glob("**/model.h5")]
    assert all(np.array_equal(one[name], values) for one in weights for name, values in weights[0].items())
    record, rows = rows_of(out)
    (summary,) = (sentence for sentence in record["summary"] if "keeps the velocity error after" in sentence)
    assert summary in (out / "index.html").read_text() and rows["grid"]["method"] == "eulerian"
    assert rows["learned"]["training_seconds"] > 0 and rows["grid"]["training_seconds"] is None
    for name, row in rows.items():
        assert row["realisations"] == 2 and row["status"] == "complete"
        both = []
        for seed in (5, 6):
            with open_product(comm, out / name / f"seed-{seed}/rollout.h5", "rollout") as file:
                model, truth = (Trajectory(file, which).read(-1, "velocity") for which in ("model", "truth"))
                # From the first frame with a filtered field on.
                assert read_attributes(file, "rollout")["start_time"] == pytest.approx(0.1)
            both.append(np.sum(model**2, dtype=float) / np.sum(truth**2, dtype=float))
        assert row["energy_ratio"] == pytest.approx(np.mean(both), rel=1e-6)
        assert row["energy_ratio_spread"] == pytest.approx(abs(both[0] - both[1]) / 2**0.5, rel=1e-4)
        assert both[0] != both[1]
    assert run_cli("compare", "small.toml", "--output", "out") == 0  # nothing is to be done again
    assert rows_of(out)[1]["learned"]["energy_ratio"] == rows["learned"]["energy_ratio"]


@pytest.mark.mpi(1, 2)
def test_a_comparison_without_its_ground_truth_writes_nothing(comm, folder, capfd):
    assert run_cli("compare", "small.toml", "--output", "out") == 2
    told = "run `eddies dns SCENE` first: make it with `eddies dns base.toml --output base`, or give --run"
    assert comm.rank > 0 or told in capfd.readouterr().err
    assert not (folder / "out").exists()


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("name, change, told", [
    ("learned", ('run = "base"', 'run = "work/learned"'), "would be that of the ground truth, work/learned; choose"),
    ("stops", ('name = "stops"', 'name = "stops"\nrun = "work/stops"'), "would be that of the ground truth, work/"),
    ("stops", ("", ""), "work/stops holds files that no comparison has made; choose another --output or another name"),
], ids=["the base's", "its own", "a run's"])
def test_runs_of_others_are_left_as_they_are(comm, folder, capfd, name, change, told):
    """A run directory in the place of a variant's: `--output runs` and the base's name are enough for that."""
    files = [folder / "work" / name / product for product in ("ground_truth.h5", "model.h5")]
    if comm.rank == 0:
        (folder / "small.toml").write_text(FILE.replace(*change))
        for path in files:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text("precious")
    comm.Barrier()
    for options in ([], ["--overwrite"]):
        assert run_cli("compare", "small.toml", "--output", "work", *options) == 2
        assert comm.rank > 0 or told in capfd.readouterr().err
    comm.Barrier()
    assert all(path.read_text() == "precious" for path in files)
    assert sorted(path for path in (folder / "work").rglob("*") if path.is_file()) == sorted(files)


@pytest.mark.mpi(1, 2)
def test_more_ranks_than_a_variant_can_use_are_refused(comm, folder, capfd):
    if comm.rank == 0:
        longer = '["training.horizons.steps=1", "training.horizons.frames=[4]"]'
        (folder / "wide.toml").write_text(FILE + f'[[variant]]\nname = "wide"\nset = {longer}\n')
    comm.Barrier()
    assert run_cli("compare", "wide.toml", "--output", "out") == 2
    errors = capfd.readouterr().err
    if comm.size == 2 and comm.rank == 0:
        assert "wide: 2 ranks are more than the 1 that it can use" in errors


@pytest.mark.mpi(1, 2, timeout=30)
def test_a_table_that_cannot_be_written_is_told_by_all(comm, tmp_path, monkeypatch):
    if comm.rank == 0:
        (tmp_path / "comparison.csv").mkdir()
    comm.Barrier()
    monkeypatch.setattr(compare, "sections", lambda *_: [Section("errors", "Errors")])
    monkeypatch.setattr(compare.ErrorAgainstTime, "summary", [])
    comparison = SimpleNamespace(name="small", title="small", subject="learned", turnovers=1.0, scenes={}, columns=None,
                                 realisations=None, base_scene=load_scene("tiny"))
    with pytest.raises(WriteError, match="comparison.csv: cannot be written .Is a directory.; choose another --output"):
        compare.write(comparison, [], {}, comm, tmp_path)


def truths_of(base):
    """What of a comparison tells of its ground truths."""
    return SimpleNamespace(base=base, base_scene=load_scene(base), changes_of_the_flow=lambda _: ["time.max_step=0.1"])


def variant_of(scene, directory):
    return VariantRun(scene, directory / "out", directory)


@pytest.mark.mpi(1)
def test_ground_truth_that_does_not_fit_is_refused(comm, tmp_path):
    comparison, scene = truths_of("tiny"), load_scene("tiny", ["name=mine"])
    with pytest.raises(ProductError, match=r"no such file; .*`eddies dns tiny --set time.max_step=0.1 --output"):
        check_ground_truth(comparison, variant_of(scene, tmp_path), comm)
    write_ground_truth(comm, tmp_path)
    with pytest.raises(SceneError, match='other settings than those of variant "mine"; make it with `eddies dns tiny'):
        check_ground_truth(comparison, variant_of(scene, tmp_path), comm)


@pytest.mark.mpi(1)
def test_frames_must_come_before_the_first_comparison(comm, tmp_path, monkeypatch):
    comparison, scene = truths_of("tiny"), load_scene("tiny", ["name=mine"])
    write_ground_truth(comm, tmp_path)  # t_eta = 0.17
    monkeypatch.setattr("eddies.workflows.compare.read_provenance", lambda _: {"fingerprint": scene.fingerprint("dns")})
    check_ground_truth(comparison, variant_of(scene, tmp_path), comm)
    coarser = load_scene("tiny", ["name=mine", "simulation.frame_interval=0.2"])
    with pytest.raises(SceneError, match=r"frame_interval = 0.2: no frame before t_eta = 0.17"):
        check_ground_truth(comparison, variant_of(coarser, tmp_path), comm)
