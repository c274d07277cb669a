"""Rollouts that start within the training of their model are known from settings and provenance alone."""

import json
import shutil
from dataclasses import replace

import pytest

from eddies.io.provenance import product_provenance
from eddies.workflows.learned.seen import seen_by, seen_flows, start_within_training
from eddies.workflows.run_directory.fingerprints import flow_fingerprint
from tests.changed_product import changed
from tests.small_scene import one_model
from tests.workflows.synthetic_run import write_ground_truth

WORDS = "its model was trained on this very flow up to 0.3 turnovers"  # window 0.5 of 0.6 turnovers


def remark(scene, directory, *changes):
    """The remark on the rollout of a scene, changed since its model was trained."""
    return start_within_training(replace(scene, **dict(changes)), directory, seen_flows(scene, directory))


@pytest.mark.parametrize("start, found", [(None, False), (0.5, False), (0.8, False), (0.49, True), (0.0, True)])
def test_a_start_before_the_end_of_the_training_window_is_named(tmp_path, start, found):
    scene = one_model("tiny")
    text = remark(scene, tmp_path, ("simulation", replace(scene.simulation, start=start)))
    assert (text is not None) == found
    assert not found or WORDS in text and "set start to 0.5 or more" in text


def test_only_the_flow_counts(tmp_path):
    """Not its duration and its tracers, and a seed only where the flow depends on it."""
    scene = one_model("tiny")
    early = ("simulation", replace(scene.simulation, start=0.3))
    longer = ("tracers", replace(scene.tracers, turnovers=0.9, particles_per_side=10))
    assert "starts 0.27 turnovers" in remark(scene, tmp_path, early, longer)
    late = ("simulation", replace(scene.simulation, start=0.4))
    assert remark(scene, tmp_path, late, longer) is None  # 0.36 turnovers
    assert remark(scene, tmp_path, early, ("seed", 2)) is None
    vortex = replace(scene, initial=replace(scene.initial, kind="taylor-green", peak_wavenumber=3.0))
    assert WORDS in remark(vortex, tmp_path, early, ("seed", 2))
    assert remark(scene, tmp_path, early, ("simulation", replace(scene.simulation, start=0.3, method="none"))) is None


def test_a_copy_of_the_initial_state_of_the_training_is_not_another_realisation(tmp_path):
    for seed, content in ((5, b"state"), (6, b"other")):
        (tmp_path / f"realisation-{seed}").mkdir()
        (tmp_path / f"realisation-{seed}/state.h5").write_bytes(content)
    shutil.copy(tmp_path / "realisation-5/state.h5", tmp_path)
    scene = one_model("tiny", ["initial.kind=file", f"initial.path={tmp_path / 'state.h5'}"],
                      ["initial.amplitude", "initial.peak_wavenumber"])
    same, other = (flow_fingerprint(scene.realisation(seed)) for seed in (5, 6))
    assert same == flow_fingerprint(scene) != other


def test_weights_of_another_run_keep_what_they_have_seen(tmp_path):
    """Weights of earlier versions store only the scene of their training, as the built-in ones do."""
    scene = one_model("tiny")
    seen = {flow_fingerprint(scene): pytest.approx(0.3)}
    assert seen_by({"scene": scene.to_toml()}, tmp_path) == seen_flows(scene, tmp_path) == seen
    assert seen_by({"scene": scene.to_toml(), "seen": {"a": 1.0}}, tmp_path) == {"a": 1.0}
    assert seen_by({"scene": 'title = "of another version"'}, tmp_path) == seen_by({}, tmp_path) == {}
    weights = one_model("tiny", ["model.path=eddies:tiny"]).model.weights_file
    assert len(seen_by(product_provenance(weights), weights.parent)) == 1


@pytest.mark.mpi(1)
def test_ground_truths_of_other_runs_count_with_their_own_flow(comm, tmp_path):
    write_ground_truth(comm, tmp_path)
    scene = one_model("tiny", [f"training.truths=['{tmp_path}']"])
    assert seen_flows(scene, tmp_path / "own") == {}  # its scene is of another version
    assert list(seen_flows(scene, tmp_path)) == [flow_fingerprint(scene)]  # that of the run itself may not exist yet
    other = one_model("tiny", ["seed=7"])
    with changed(tmp_path / "ground_truth.h5") as file:
        file.attrs["provenance"] = json.dumps(json.loads(file.attrs["provenance"]) | {"scene": other.to_toml()})
    assert list(seen_flows(scene, tmp_path / "own")) == [flow_fingerprint(other)]
