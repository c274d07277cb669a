"""What is said of products that do not belong together, and of numbers that are not finite."""

import numpy as np
import pytest

from eddies.io.hdf5 import open_product
from eddies.io.provenance import product_provenance
from eddies.workflows.product_warnings import changed_truths, mixed_products, not_finite
from tests.changed_product import changed
from tests.workflows.synthetic_run import write_ground_truth, write_kernel, write_model, write_rollout

TRUTH = {"id": "t1", "made_from": {}, "date": "2030-01-01", "scene": "seed = 1\n[flow]\ncells = 48"}
MODEL = {"id": "m1", "made_from": {"ground_truth": "t1"}, "date": "2030-01-02", "scene": TRUTH["scene"]}
ROLLOUT = {"id": "r1", "made_from": {"ground_truth": "t1", "model": "m1"}, "date": "2030-01-03",
           "scene": TRUTH["scene"]}
MADE = "rollout.h5 (made 2030-01-03) was made from "
REMEDY = ": remove it and run `eddies simulate` again, or take what is compared as of different flows or models"


def test_products_that_belong_together_need_no_word():
    assert mixed_products({"ground_truth": TRUTH, "model": MODEL, "rollout": ROLLOUT}) == []
    assert mixed_products({"ground_truth": TRUTH}) == []


def test_another_ground_truth_is_said_of_all_that_came_from_the_first():
    other = {**TRUTH, "id": "t2", "date": "2030-02-01", "scene": "seed = 2\n[flow]\ncells = 64"}
    said = mixed_products({"ground_truth": other, "model": MODEL, "rollout": ROLLOUT})
    here = ("another ground_truth.h5 than the one here, made 2030-02-01 with other settings (seed = 1, now 2, "
            "flow.cells = 48, now 64)")
    assert [sentence.split(" ", 1)[0] for sentence in said] == ["model.h5", "rollout.h5"]
    assert said[1] == MADE + here + REMEDY and "remove it and run `eddies train` again" in said[0]


def test_another_model_of_the_same_settings_and_a_ground_truth_that_is_gone():
    said = mixed_products({"model": {**MODEL, "id": "m2", "date": "2030-02-01", "made_from": {}}, "rollout": ROLLOUT})
    assert said == [MADE + "a ground_truth.h5 that is not here and from another model.h5 than the one here, made "
                    "2030-02-01 with the same settings" + REMEDY]


@pytest.mark.mpi(1)
def test_a_truth_of_another_run_that_is_another_now_is_named(comm, tmp_path):
    write_ground_truth(comm, tmp_path)
    path = str(tmp_path / "ground_truth.h5")
    known = product_provenance(path)["id"]
    for truths, said in (({path: known}, 0), ({path: "t9"}, 1), ({str(tmp_path / "gone.h5"): "t9"}, 0)):
        found = changed_truths({**MODEL, "truths": truths})
        assert len(found) == said and all(f"was trained on another {path} than is there now" in each for each in found)


def test_what_is_gone_may_be_brought_back():
    assert mixed_products({"model": MODEL}) == [
        "model.h5 (made 2030-01-02) was made from a ground_truth.h5 that is not here: remove it and run `eddies train` "
        "again, or bring back what is missing"]


def test_a_product_of_before_there_were_ids_says_so_beside_one_that_has_one():
    old = {"date": "2029-12-01", "scene": ""}
    assert mixed_products({"ground_truth": old, "model": old, "rollout": old}) == []
    # Made from one without an id, the rollout knows of that, whichever it was.
    assert mixed_products({"ground_truth": old, "rollout": {**ROLLOUT, "made_from": {"ground_truth": None}}}) == []
    assert mixed_products({"ground_truth": TRUTH, "rollout": old}) == [
        "rollout.h5 (made 2029-12-01) does not say what it was made from: whether it belongs to ground_truth.h5 (made "
        "2030-01-01) is not known; remove it and run `eddies simulate` again"]
    from_old = {**ROLLOUT, "made_from": {"ground_truth": None}}
    assert len(mixed_products({"ground_truth": TRUTH, "rollout": from_old})) == 1


def said_of(comm, directory, kind, **holes):
    """What is said of a product in which numbers are replaced: column by place with "__" for "/", an index, a value."""
    path = directory / f"{kind}.h5"
    with changed(path) as file:
        for place, (index, value) in holes.items():
            file[place.replace("__", "/")][index] = value
    with open_product(comm, path, kind) as file:
        return not_finite(file, kind)


@pytest.mark.mpi(1)
def test_what_is_infinite_or_missing_by_design_is_not_said(comm, tmp_path):
    """An incompressible fluid's sound speed, the scales of an inviscid one, what a step of a training did not measure;
    of the loss of a step there is always one."""
    write_ground_truth(comm, tmp_path, frames=3, stationary=True, density=False)
    write_kernel(comm, tmp_path)
    write_model(comm, tmp_path)
    write_rollout(comm, tmp_path)
    assert said_of(comm, tmp_path, "ground_truth", statistics__taylor_scale=(3, np.inf)) == ""
    assert [said_of(comm, tmp_path, kind) for kind in ("kernel", "model", "rollout")] == ["", "", ""]
    assert said_of(comm, tmp_path, "model", history__loss=(7, np.nan)) == (
        "model.h5 holds numbers that are not finite (history/loss, row 7): remove it and run `eddies train` again")


@pytest.mark.mpi(1)
def test_places_are_named_and_the_last_are_counted(comm, tmp_path):
    write_ground_truth(comm, tmp_path)
    places = [f"statistics__{name}" for name in ("energy", "skewness", "taylor_scale", "time", "turnovers")]
    assert said_of(comm, tmp_path, "ground_truth", **{place: (5, np.nan) for place in places}) == (
        "ground_truth.h5 holds numbers that are not finite (statistics/energy, row 5; statistics/skewness, row 5; "
        "statistics/taylor_scale, row 5; statistics/time, row 5 and 1 more): remove it and run `eddies dns` again")


@pytest.mark.mpi(1)
@pytest.mark.parametrize("status, remedy", [("complete", "remove it and run `eddies simulate` again"),
                                            ("stopped: particle 17 is too fast", "the rollout stopped: particle 17")])
def test_a_rollout_that_was_stopped_says_why(comm, tmp_path, status, remedy):
    write_rollout(comm, tmp_path, status=status, broken=8)
    said = said_of(comm, tmp_path, "rollout")
    assert said.startswith("rollout.h5 holds numbers that are not finite (particles/model/velocity/value, frame 8): "
                           + remedy)
