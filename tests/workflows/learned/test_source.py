"""Trained weights of another run: what is read, and which scenes are refused."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from eddies.io.hdf5 import ProductError
from eddies.io.weights import StoredWeights, save_weights
from eddies.particles.flow_units import ReferenceScales
from eddies.scene.rules import quoted
from eddies.scene.scene import Model, SceneError, load_scene
from eddies.stages import Step, check_inputs
from eddies.workflows.learned.model import trained_model
from eddies.workflows.learned.source import ModelDefinition, read_source, trained_on
from tests.small_scene import TINY, one_model

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


@pytest.mark.mpi(1, 2)
def test_a_run_directory_or_its_file_gives_description_weights_and_tables(comm, tmp_path):
    write_source(comm, tmp_path)
    for path in (tmp_path, tmp_path / "model.h5"):
        source = read(scene(f"model.path={path}"), comm)
        assert source.path == tmp_path / "model.h5"
        assert source.description == described() and source.provenance["mach_turbulent"] == 0.08
        assert np.array_equal(source.weights["bias"], np.arange(3.0)) and set(source.tables) == {"a_priori"}


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
    ("tracers.filter_width", "0.9", "1.04719755")])
def test_a_model_of_another_form_is_refused_with_both_values(comm, tmp_path, own, key, here, there):
    own("own_networks", "from torch import nn\nclass Net(nn.Module):\n    def forward(self, features): pass\n")
    write_source(comm, tmp_path)
    with pytest.raises(SceneError) as error:
        read(scene(f"model.path={tmp_path}", f"{key}={here}"), comm)
    section, _, name = key.rpartition(".")
    for part in (f"[{section}] {name} = {here}", str(tmp_path / "model.h5"), there):
        assert part in str(error.value)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("terms", [("pressure", "pairs"), ("pairs", "pressure", "stress", "damping", "relaxation")])
def test_other_terms_are_refused_with_both_lists(comm, tmp_path, terms):
    """Another order too, because it changes the rounding of sums."""
    write_source(comm, tmp_path)
    with pytest.raises(SceneError) as error:
        read(scene_with(tmp_path, *terms), comm)
    for part in (f"[model] terms = {quoted(terms)}", '["pressure", "stress", "viscosity", "damping", "relaxation", "p'):
        assert part in str(error.value)


@pytest.mark.mpi(2)
def test_missing_weights_are_refused_before_any_work_on_all_ranks(comm, tmp_path):
    wanted = scene(f"model.path={tmp_path}")
    with pytest.raises(ProductError, match=r"\[model\] path = .*model.h5: no such file; run `eddies train"):
        check_inputs(Step(wanted, wanted.stages, tmp_path), comm)
    check_inputs(Step(wanted, ("dns",), tmp_path), comm)


@pytest.mark.mpi(1, 2)
def test_a_file_never_has_a_class_imported(comm, tmp_path, own):
    """The scene must name the class again, and one error says so."""
    if comm.rank == 0:
        own("own_source", OWN_TERM)
    comm.Barrier()
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
