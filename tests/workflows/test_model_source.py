"""Trained weights of another run: what is read, and which scenes are refused."""

import dataclasses
import json

import numpy as np
import pytest

from eddies.io.hdf5 import ProductError
from eddies.io.weights import save_weights
from eddies.scene import SceneError, load_scene
from eddies.stages import check_inputs
from eddies.workflows.model_source import differences, read_source

# Of the scene tiny: filter width two spacings, whatever their number.
SCALES = {"length": 0.5, "spacing": 0.25}
FORM = {"hidden": [8, 8], "basis": "corrected", "closure": "poisson-stress", "eddy_viscosity": "none"}
DESCRIPTION = {"scales": SCALES, "neighbors": 56.0, "support": 0.6, **FORM}


def scene(*overrides):
    return load_scene("tiny", overrides)


def write_source(comm, directory, description=DESCRIPTION):
    comm.Barrier()
    save_weights(comm, directory / "model.h5", "model", description, {"bias": np.arange(3.0)}, {"mach_turbulent": 0.08},
                 {"a_priori": {"delay": np.arange(2.0)}})


@pytest.mark.mpi(1, 2)
def test_a_run_directory_or_its_file_gives_description_weights_and_tables(comm, tmp_path):
    write_source(comm, tmp_path)
    for path in (tmp_path, tmp_path / "model.h5"):
        source = read_source(scene(f"model.path={path}"), comm)
        assert source.path == tmp_path / "model.h5"
        assert source.description == DESCRIPTION and source.provenance["mach_turbulent"] == 0.08
        assert np.array_equal(source.weights["bias"], np.arange(3.0)) and set(source.tables) == {"a_priori"}


@pytest.mark.mpi(1)
@pytest.mark.parametrize("override, message", [
    ("model.hidden=[8, 9]", "[model] hidden = [8, 9], but {} was trained with [8, 8]; set it to that"),
    ("model.basis=paper", '[model] basis = "paper", but {} was trained with "corrected"'),
    ("kernel.neighbors=50", "[kernel] neighbors = 50.0, but {} was trained with 56.0"),
    ("tracers.filter_width=0.9", "[tracers] filter_width = 0.9, but {} was trained with 1.04719755"),
])
def test_another_form_is_refused_with_both_values(comm, tmp_path, override, message):
    write_source(comm, tmp_path)
    with pytest.raises(SceneError) as error:
        read_source(scene(f"model.path={tmp_path}", override), comm)
    assert message.format(tmp_path / "model.h5") in str(error.value)


@pytest.mark.mpi(1, 2)
def test_missing_weights_are_refused_before_any_work_on_all_ranks(comm, tmp_path):
    wanted = scene(f"model.path={tmp_path}")
    with pytest.raises(ProductError, match=r"tiny: \[model\] path = .*model.h5: no such file; run `eddies train"):
        check_inputs(wanted.stages, wanted, comm, tmp_path)
    check_inputs(["dns"], wanted, comm, tmp_path)


def test_keys_that_a_file_is_too_old_to_know_had_their_defaults():
    """As if the eddy viscosity had been added since."""
    description = {key: value for key, value in DESCRIPTION.items() if key != "eddy_viscosity"}
    assert not list(differences(scene(), description))
    found = list(differences(scene("model.eddy_viscosity=monaghan"), description))
    assert found == [("[model] eddy_viscosity", '"monaghan"', '"none"')]


def test_every_key_of_the_form_is_stored_with_a_model():
    """What a scene says of the form must be found in the description of its model under the same name."""
    from eddies.particles.pair_forces import PairModel
    from eddies.particles.reference_scales import ReferenceScales
    scales = ReferenceScales(**dict.fromkeys([field.name for field in dataclasses.fields(ReferenceScales)], 1.0))
    stored = json.loads(json.dumps(PairModel(scales, 1.5, 56.0).state_description()))
    assert {field.name for field in dataclasses.fields(scene().model)} - {"path"} <= stored.keys()
