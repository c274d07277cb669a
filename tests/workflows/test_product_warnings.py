"""Warnings about products that do not belong together, and about numbers that are not finite."""

import json

import numpy as np
import pytest

from eddies.io.hdf5 import open_product
from eddies.io.provenance import product_provenance
from eddies.workflows.product_warnings import changed_truths, mixed_products, not_finite, old_products
from eddies.workflows.run_directory.fingerprints import stage_provenance
from eddies.workflows.status import status_lines
from tests.changed_product import changed
from tests.small_scene import one_model
from tests.workflows.synthetic_run import write_ground_truth, write_kernel, write_model, write_rollout, write_run

TRUTH = {"id": "t1", "made_from": {}, "date": "2030-01-01", "scene": "seed = 1\n[flow]\ncells = 48"}
MODEL = {"id": "m1", "made_from": {"ground_truth": "t1"}, "date": "2030-01-02", "scene": TRUTH["scene"]}
ROLLOUT = {"id": "r1", "made_from": {"ground_truth": "t1", "model": "m1"}, "date": "2030-01-03",
           "scene": TRUTH["scene"]}


def test_products_that_belong_together_need_no_warning():
    assert mixed_products({"ground_truth": TRUTH, "model": MODEL, "rollout": ROLLOUT}) == []
    assert mixed_products({"ground_truth": TRUTH}) == []


def test_another_ground_truth_is_named_for_all_that_came_from_the_first():
    other = {**TRUTH, "id": "t2", "date": "2030-02-01", "scene": "seed = 2\n[flow]\ncells = 64"}
    model, rollout = mixed_products({"ground_truth": other, "model": MODEL, "rollout": ROLLOUT})
    assert model.startswith("model.h5 (made 2030-01-02)") and "remove model.h5 and run `eddies train` again" in model
    for words in ("rollout.h5 (made 2030-01-03) was made from another ground_truth.h5", "made 2030-02-01",
                  "seed = 1, now 2", "flow.cells = 48, now 64", "`eddies simulate`"):
        assert words in rollout


def test_another_model_of_the_same_settings_and_a_ground_truth_that_is_gone():
    sentence, = mixed_products({"model": {**MODEL, "id": "m2", "made_from": {}}, "rollout": ROLLOUT})
    assert "a ground_truth.h5 that is not here and from another model.h5" in sentence and "same settings" in sentence
    sentence, = mixed_products({"model": MODEL})
    assert "a ground_truth.h5 that is not here" in sentence and "restore the missing file" in sentence


@pytest.mark.mpi(1)
def test_a_truth_of_another_run_that_has_changed_is_named(comm, tmp_path):
    write_ground_truth(comm, tmp_path)
    path = str(tmp_path / "ground_truth.h5")
    known = product_provenance(path)["id"]
    for truths, number in (({path: known}, 0), ({path: "t9"}, 1), ({str(tmp_path / "gone.h5"): "t9"}, 0)):
        found = changed_truths({**MODEL, "truths": truths})
        assert len(found) == number and all(f"was trained on {path}, which has changed" in each for each in found)


def warning_of(comm, directory, kind, **holes):
    """The warning of a product in which numbers are replaced: column by place with "__" for "/", an index, a value."""
    path = directory / f"{kind}.h5"
    with changed(path) as file:
        for place, (index, value) in holes.items():
            file[place.replace("__", "/")][index] = value
    with open_product(comm, path, kind) as file:
        return not_finite(file, kind)


@pytest.mark.mpi(1)
def test_numbers_that_are_not_finite_are_placed(comm, tmp_path):
    write_ground_truth(comm, tmp_path, frames=3, stationary=True, density=False)
    write_kernel(comm, tmp_path)
    write_model(comm, tmp_path)
    write_rollout(comm, tmp_path)
    # Infinite scales, and numbers that not every step of a training has, are no reason for a warning.
    assert warning_of(comm, tmp_path, "ground_truth", statistics__taylor_scale=(2, np.inf)) == ""
    assert [warning_of(comm, tmp_path, kind) for kind in ("kernel", "model", "rollout")] == ["", "", ""]
    model = warning_of(comm, tmp_path, "model", history__loss=(7, np.nan))
    assert "(history/loss, row 7)" in model and "`eddies train`" in model
    places = [f"statistics__{name}" for name in ("energy", "skewness", "taylor_scale", "time", "turnovers")]
    truth = warning_of(comm, tmp_path, "ground_truth", **{place: (2, np.nan) for place in places})
    assert "(statistics/energy, row 2; " in truth and "statistics/time, row 2 and 1 more)" in truth


@pytest.mark.mpi(1)
@pytest.mark.parametrize("status, remedy", [("complete", "remove rollout.h5 and run `eddies simulate`"),
                                            ("stopped: particle 17 is too fast", "the rollout stopped: particle 17")])
def test_a_rollout_that_was_stopped_gives_the_reason(comm, tmp_path, status, remedy):
    write_rollout(comm, tmp_path, status=status, broken=8)
    assert f"(particles/model/velocity/value, frame 8): {remedy}" in warning_of(comm, tmp_path, "rollout")


@pytest.mark.mpi(1)
def test_files_that_are_not_found_from_here_make_no_product_old(comm, tmp_path, monkeypatch):
    """A stored scene may name them relative to another working directory."""
    there, here = tmp_path / "there", tmp_path / "here"
    for folder in (there, here):
        folder.mkdir()
    (there / "start.h5").write_text("state")
    monkeypatch.chdir(there)
    scene = one_model("tiny", ["initial.kind=file", "initial.path=start.h5"],
                      ["initial.amplitude", "initial.peak_wavenumber"])
    write_run(comm, tmp_path / "run")
    (tmp_path / "run/scene.toml").write_text(scene.to_toml())
    for product, stage in (("ground_truth", "dns"), ("rollout", "simulate")):
        with changed(tmp_path / f"run/{product}.h5") as file:
            origin = json.loads(file.attrs["provenance"]) | stage_provenance(scene, stage) | {"made_from": {}}
            file.attrs["provenance"] = json.dumps(origin)
    monkeypatch.chdir(here)
    assert old_products(scene, tmp_path / "run").keys() == {tmp_path / "run/kernel.h5", tmp_path / "run/model.h5"}
    assert any("not found from here" in line for line in status_lines(tmp_path / "run"))
