"""Trained weights of another run: what is read, which scenes are refused, and which flows the weights have seen."""

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from eddies.io.hdf5 import ProductError
from eddies.io.provenance import product_provenance
from eddies.io.weights import StoredWeights, save_weights
from eddies.particles.flow_units import ReferenceScales
from eddies.scene.scene import Model, SceneError, load_scene
from eddies.stages import Step, check_inputs
from eddies.workflows.learned.model import trained_model
from eddies.workflows.learned.source import (ModelDefinition, read_source, seen_by, seen_flows, start_within_training,
                                             trained_on)
from eddies.workflows.run_directory.fingerprints import flow_fingerprint
from tests.commands import first_rank
from tests.changed_product import changed
from tests.small_scene import TINY, one_model
from tests.workflows.synthetic_run import write_ground_truth

# The filter width is two spacings, as in the scene tiny.
SCALES = ReferenceScales(filter_width=0.5, spacing=0.25, velocity=1.0, acceleration=2.0, density_mean=1.0,
                         viscosity=0.01)
OWN_TERM = """
import eddies
from pathlib import Path

Path(__file__).with_name("imported").touch()

class Drag(eddies.Term):
    def forward(self, context):
        return eddies.Rates(acceleration=-context.particles.velocity)
"""


def scene_with(path, *terms):
    return replace(load_scene(TINY), model=Model(terms=terms, path=str(path)))


def scene(*overrides):
    return load_scene(TINY, ["model.pairs.hidden=[8, 8]", *overrides])


def described(*overrides):
    return json.loads(json.dumps(ModelDefinition.of(scene(*overrides)).describe(SCALES)))


def read(scene, comm):
    return read_source(scene.name, ModelDefinition.of(scene), comm)


def write_source(comm, directory, description=None):
    comm.Barrier()
    save_weights(comm, directory / "model.h5", "model", description or described(), {"bias": np.arange(3.0)},
                 {"mach_turbulent": 0.08}, {"a_priori": {"delay": np.arange(2.0)}})


@pytest.mark.mpi(2)
def test_a_run_directory_or_its_file_gives_description_weights_and_tables(comm, tmp_path):
    write_source(comm, tmp_path)
    for path in (tmp_path, tmp_path / "model.h5"):
        source = read(scene(f"model.path={path}"), comm)
        assert source.path == tmp_path / "model.h5"
        assert source.description == described() and source.provenance["mach_turbulent"] == 0.08
        assert np.array_equal(source.weights["bias"], np.arange(3.0)) and set(source.tables) == {"a_priori"}


TERMS = '["pressure", "stress", "viscosity", "damping", "relaxation", "p'


@pytest.mark.parametrize("overrides, ratio", [((), 1), (("model.neighbors=28",), 0.5)])
def test_the_radius_of_interaction_is_that_of_the_kernel_unless_the_model_has_its_own(overrides, ratio):
    given = scene(*overrides)
    support = given.tracers.radius_of(given.kernel.neighbors)  # holds 56 particles
    assert ModelDefinition.of(given).radius == pytest.approx(support * ratio ** (1 / 3), rel=1e-12)
    assert ModelDefinition.of(replace(given, kernel=None, model=None, training=None, simulation=None)).neighbors == 60


INPUTS = '["density", "distance", "speed", "approach"]'


@pytest.mark.mpi(1)
@pytest.mark.parametrize("key, here, there", [
    ("model.pairs.hidden", "[8, 9]", "[8, 8]"),
    ("model.pairs.basis", '"paper"', '"corrected"'),
    ("model.pairs.inputs", INPUTS, '["distance", "speed", "approach"]'),
    ("model.pairs.network", '"own_networks:Net"', '"dense"'),
    ("model.neighbors", "50.0", "56.0"),
    ("tracers.filter_width", "0.9", "1.04719755"),
    ("model.terms", '["pressure", "pairs"]', TERMS),
    ("model.terms", '["pairs", "pressure", "stress", "damping", "relaxation"]', TERMS)])
def test_a_model_of_another_form_is_refused_with_both_values(comm, tmp_path, own, key, here, there):
    """Another order of terms too, because it changes the rounding of sums."""
    own("own_networks", "from torch import nn\nclass Net(nn.Module):\n    def forward(self, features): pass\n")
    write_source(comm, tmp_path)
    changed = scene_with(tmp_path, *json.loads(here)) if key == "model.terms" else scene(
        f"model.path={tmp_path}", f"{key}={here}")
    with pytest.raises(SceneError) as error:
        read(changed, comm)
    section, _, name = key.rpartition(".")
    for part in (f"[{section}] {name} = {here}", str(tmp_path / "model.h5"), there):
        assert part in str(error.value)


@pytest.mark.mpi(2)
def test_missing_weights_are_refused_before_any_work_on_all_ranks(comm, tmp_path):
    wanted = scene(f"model.path={tmp_path}")
    with pytest.raises(ProductError, match=r"\[model\] path = .*model.h5: no such file; run `eddies train"):
        check_inputs(Step(wanted, wanted.stages, tmp_path), comm)
    check_inputs(Step(wanted, ("dns",), tmp_path), comm)


@pytest.mark.mpi(2)
def test_a_file_never_has_a_class_imported(comm, tmp_path, own):
    """The scene must name the class again, and one error says so."""
    first_rank(comm, own, "own_source", OWN_TERM)
    terms = {"pressure": {"force": True}, "own_source:Drag": {}}
    write_source(comm, tmp_path, {"terms": terms, "scales": SCALES.to_dict(), "neighbors": 56.0})
    with pytest.raises(SceneError, match=r'terms = \["pressure"\], .* \["pressure", "own_source:Drag"\]'):
        read(scene_with(tmp_path, "pressure"), comm)
    assert "own_source" not in sys.modules and not (tmp_path / "imported").exists()
    comm.Barrier()
    if comm.rank == 0:  # whose path leads to the module
        assert scene_with(tmp_path, "pressure", "own_source:Drag").foreign == ("own_source:Drag",)
        assert (tmp_path / "imported").exists()


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name, base", [("hit", "hit"), ("hit-coarse", "hit-coarse"), ("hit-local", "hit"),
                                        ("hit-small", "hit-small")])
def test_weights_of_the_first_version_are_read(comm, name, base):
    """Keys of terms that no longer exist have the values at which they are now fixed."""
    changes = ["model.preset=local"] if name == "hit-local" else []
    found = one_model(base, [*changes, f"model.path=eddies:{name}"])
    source = read(found, comm)
    scales = ReferenceScales(**source.description["scales"])
    model = trained_model(ModelDefinition.of(found), source, scales, comm)
    assert {key: value.shape for key, value in source.weights.items()} == {
        key: tuple(value.shape) for key, value in model.state_dict().items()}


def test_a_former_key_with_another_value_is_another_model():
    resolved = ModelDefinition.of(load_scene(TINY, ["model.preset=resolved"]))
    description = json.loads(json.dumps(resolved.describe(SCALES)))
    for force, differences in ((True, []), (False, [("[model.pressure] force", "true", "false")])):
        description["terms"]["pressure"] = {"force": force}
        assert list(resolved.differences(description)) == differences


def source_of(provenance, tables):
    return StoredWeights(Path("model.h5"), {}, {}, tables, provenance)


def test_the_run_in_which_weights_were_trained_is_kept_from_run_to_run():
    errors, mach = {"a_priori": {"acceleration_error": 0.3}}, {"mach_turbulent": 0.08}
    origin, own = trained_on(source_of(mach, errors), "runs/first")
    assert origin == {"path": "runs/first", **mach} and own == errors["a_priori"]
    tables = {"a_priori": {"acceleration_error": 0.5}, "source_a_priori": own}
    assert trained_on(source_of({"mach_turbulent": 0.16, "source": origin}, tables), "runs/second") == (origin, own)

    # Trained on another flow only: the Mach number and the errors are not those of the run.
    elsewhere = mach | {"made_from": {"ground_truth": "t1"}, "truths": {"runs/a/ground_truth.h5": "t2"},
                        "mach_of_truths": {"runs/a/ground_truth.h5": 0.04}}
    found = trained_on(source_of(elsewhere, errors), "runs/first")
    assert found == ({"path": "runs/first", "truths": {"runs/a/ground_truth.h5": 0.04}}, None)
    assert trained_on(source_of(mach | {"source": found[0]}, errors), "runs/second") == found


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
