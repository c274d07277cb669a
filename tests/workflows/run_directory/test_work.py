"""The work in a run directory that is kept, and that would be lost."""

import errno
import json
from contextlib import nullcontext

import pytest

from eddies.io import damage
from eddies.io.checkpoint import CheckpointDirectory
from eddies.io.hdf5 import ProductError, create_product
from eddies.pipeline import STAGES
from eddies.scene.scene import load_scene
from eddies.workflows.run_directory.fingerprints import stage_fingerprint, stage_provenance
from eddies.workflows.run_directory.work import WouldReplaceWork, find_work
from tests.small_scene import TINY

MAKING = ("dns", "train-kernel", "train", "simulate")


@pytest.fixture
def scene():
    return load_scene(TINY)


def leave(comm, directory, scene, stages=MAKING):
    """The products of some stages of a scene, without content."""
    for stage in stages:
        with create_product(comm, directory / STAGES[stage].file, STAGES[stage].product,
                            stage_provenance(scene, stage)):
            pass


def save(comm, directory, scene, stage, step):
    """A checkpoint of a stage."""
    checkpoints = CheckpointDirectory(comm, directory / STAGES[stage].checkpoints, stage_fingerprint(scene, stage))
    checkpoints.write(step, {"a": 1})


def starts(work):
    return {stage: action.start for stage, action in work.actions.items()}


FOUND = {"none": None, "same": "tracers.turnovers=0.6", "shorter": "tracers.turnovers=0.5",
         "longer": "tracers.turnovers=0.7", "other": "seed=5", "damaged": ""}
CHECKPOINTS = {"no": None, "fitting": "seed=1", "foreign": "seed=6"}
PRODUCT, BOTH = ["ground_truth.h5"], ["ground_truth.h5", "checkpoints"]


@pytest.mark.mpi(1)
@pytest.mark.parametrize("product, checkpoints, start, drops, lost", [
    ("none", "no", "begin", False, []),
    ("none", "fitting", "continue", False, []),
    ("none", "foreign", "begin", True, ["checkpoints"]),
    ("same", "no", "skip", False, []),
    ("same", "fitting", "skip", False, []),
    ("same", "foreign", "skip", False, []),
    ("shorter", "no", "begin", False, PRODUCT),
    ("shorter", "fitting", "continue", False, []),
    ("shorter", "foreign", "begin", True, BOTH),
    ("longer", "no", "begin", False, PRODUCT),
    ("longer", "fitting", "begin", True, PRODUCT),
    ("longer", "foreign", "begin", True, BOTH),
    ("other", "no", "begin", False, PRODUCT),
    ("other", "fitting", "continue", False, PRODUCT),
    ("other", "foreign", "begin", True, BOTH),
    ("damaged", "no", "begin", False, PRODUCT),
    ("damaged", "fitting", "continue", False, PRODUCT),
    ("damaged", "foreign", "begin", True, BOTH),
])
def test_what_is_found_decides_what_a_run_does(comm, tmp_path, scene, product, checkpoints, start, drops, lost):
    """The table of cases, for the direct simulation of a scene with 0.6 turnovers."""
    course = "course of the product"
    if FOUND[product]:
        other = load_scene(TINY, [FOUND[product]])
        course = stage_fingerprint(other, "dns", STAGES["dns"].duration)
        with create_product(comm, tmp_path / "ground_truth.h5", "ground_truth", stage_provenance(other, "dns") | {
                "course": course, "duration": other.duration}):
            pass
    elif product == "damaged":
        (tmp_path / "ground_truth.h5").write_bytes(b"damaged")
    if CHECKPOINTS[checkpoints]:
        of = load_scene(TINY, [CHECKPOINTS[checkpoints]])
        CheckpointDirectory(comm, tmp_path / "checkpoints", stage_fingerprint(of, "dns", STAGES["dns"].duration)).write(
            5, {"a": 1})
    work = find_work(["dns"], scene, tmp_path)
    assert (work.actions["dns"].start, work.actions["dns"].drops) == (start, drops)
    assert [each.split()[0] for each in work.lost] == lost
    with pytest.raises(WouldReplaceWork, match="--overwrite") if lost else nullcontext():
        find_work(["dns"], scene, tmp_path, overwrite=False)


@pytest.mark.mpi(1)
def test_the_last_state_of_a_product_is_not_listed_beside_it(comm, tmp_path, scene):
    course = stage_fingerprint(scene, "dns", STAGES["dns"].duration)
    CheckpointDirectory(comm, tmp_path / "checkpoints", course).write(9, {})
    provenance = stage_provenance(scene, "dns") | {"course": course, "duration": scene.duration}
    with create_product(comm, tmp_path / "ground_truth.h5", "ground_truth", provenance):
        pass
    work = find_work(["dns"], load_scene(TINY, ["seed=5"]), tmp_path)
    assert [each.split()[0] for each in work.lost] == ["ground_truth.h5"] and work.actions["dns"].drops


@pytest.mark.mpi(1)
def test_what_fits_is_done_whatever_is_to_be_made_before_it(comm, tmp_path, scene):
    for directory in (tmp_path, tmp_path / "nowhere"):
        work = find_work(scene.stages, scene, directory)
        assert {*starts(work).values()} == {"begin"} and not work.lost
    leave(comm, tmp_path, scene)
    assert {*starts(find_work(MAKING, scene, tmp_path)).values()} == {"skip"}
    (tmp_path / "kernel.h5").unlink()
    work = find_work(MAKING, scene, tmp_path)
    assert starts(work) == dict.fromkeys(MAKING, "skip") | {"train-kernel": "begin"} and not work.lost
    # A link is not work, whatever it leads to.
    leave(comm, tmp_path, load_scene(TINY, ["kernel.steps=5"]), ["train-kernel"])
    (tmp_path / "here").mkdir()
    (tmp_path / "here/kernel.h5").symlink_to("../kernel.h5")
    assert not find_work(["train-kernel"], scene, tmp_path / "here").lost


@pytest.mark.mpi(1)
@pytest.mark.parametrize("change, stages, lost, changes", [
    ("simulation.turnovers=0.1", MAKING, ["rollout.h5"], "simulation.turnovers = 0.3, now 0.1"),
    ("training.steps=70", MAKING, ["model.h5", "rollout.h5"], "training.steps = 60, now 70"),
    ("training.steps=70", ("dns", "train-kernel"), [], None),
    ("seed=5", MAKING, ["ground_truth.h5", "kernel.h5", "model.h5", "rollout.h5"], "seed = 1, now 5"),
    ("seed=5", ("dns",), ["ground_truth.h5"], "seed = 1, now 5"),
    ("title=another", MAKING, [], None),
])
def test_what_would_be_replaced_is_named_with_cost_and_reason(comm, tmp_path, scene, change, stages, lost, changes):
    leave(comm, tmp_path, scene)
    (tmp_path / "stage_seconds.json").write_text(json.dumps({"dns": 125, "simulate": 3.2}))
    work = find_work(stages, load_scene(TINY, [change]), tmp_path)
    assert [each.split()[0] for each in work.lost] == lost
    assert starts(work) == {stage: "begin" if STAGES[stage].file in lost else "skip" for stage in stages}
    with pytest.raises(WouldReplaceWork) if lost else nullcontext() as refused:
        find_work(stages, load_scene(TINY, [change]), tmp_path, overwrite=False)
    if not lost:
        return
    message = str(refused.value)
    assert changes in message and "--overwrite" in message
    assert ("ground_truth.h5 (took 2 min 05 s)" in message) == ("ground_truth.h5" in lost)
    assert ("model.h5 (made 2" in message) == ("model.h5" in lost)
    assert ("rollout.h5 (took 3 s)" in message) == ("rollout.h5" in lost)


@pytest.mark.mpi(1)
def test_checkpoints_that_would_be_lost_are_named_with_step_time_and_reason(comm, tmp_path, scene):
    other = load_scene(TINY, ["training.steps=70"])
    save(comm, tmp_path, other, "train", 5)
    (tmp_path / "scene.toml").write_text(other.to_toml())
    (tmp_path / "stage_seconds.json").write_text('{"train": 125}')
    with pytest.raises(WouldReplaceWork, match=r"steps = 70, now 60.* checkpoints-train \(step 5, took 2 min 05 s\)"):
        find_work(scene.stages, scene, tmp_path, overwrite=False)
    assert not find_work(other.stages, other, tmp_path).lost
    assert not find_work(["dns"], scene, tmp_path).lost
    save(comm, tmp_path, scene, "train", 3)
    assert not find_work(scene.stages, scene, tmp_path).lost  # there is one to go on from
    (tmp_path / "checkpoints-train/step-00000003.h5").write_text("damaged")
    assert find_work(scene.stages, scene, tmp_path).actions["train"].drops
    # Those beside a complete model are removed; those of a direct simulation stay, because a longer run continues.
    leave(comm, tmp_path, scene, ["train"])
    save(comm, tmp_path, scene, "train", 7)
    action = find_work(["train"], scene, tmp_path).actions["train"]
    assert action.start == "skip" and action.drops


@pytest.mark.mpi(1)
def test_checkpoints_of_another_format_and_unreadable_products_are_not_replaced(comm, tmp_path, scene, monkeypatch):
    """A product that the system refuses to read may be sound, unlike one that HDF5 finds damaged."""
    with monkeypatch.context() as patch:
        patch.setattr("eddies.io.checkpoint.FORMAT", 4)
        save(comm, tmp_path, scene, "train", 5)
    assert find_work(["train"], scene, tmp_path).lost == ["checkpoints-train (step 5)"]

    def refuse(path):
        raise OSError(errno.EIO, "unable to read")

    leave(comm, tmp_path, scene, ["dns"])
    with monkeypatch.context() as patch, pytest.raises(ProductError, match="ground_truth.h5: cannot be read: Input"):
        patch.setattr(damage, "_opened", refuse)
        find_work(scene.stages, scene, tmp_path)
    save(comm, tmp_path, scene, "dns", 5)
    with monkeypatch.context() as patch, pytest.raises(ProductError, match="step-00000005.h5: cannot be read: Input"):
        patch.setattr(damage, "_opened", refuse)
        find_work(["dns"], scene, tmp_path)
    (tmp_path / "ground_truth.h5").write_bytes(b"damaged")
    with pytest.raises(WouldReplaceWork, match=r"ground_truth.h5 \(damaged"):
        find_work(["dns"], scene, tmp_path, overwrite=False)
