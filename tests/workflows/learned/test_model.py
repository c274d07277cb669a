"""Model and kernel with the weights of a file: what is stored beside them, what is read, and what is refused."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import nn

from eddies.io.hdf5 import ProductError
from eddies.io.provenance import product_provenance
from eddies.io.weights import load_weights, save_weights
from eddies.particles.flow_units import ReferenceScales
from eddies.particles.smoothing_kernels import KernelNetwork
from eddies.scene.scene import Model, SceneError, load_scene
from eddies.scene.terms import PRESETS
from eddies.workflows.learned.model import load_form, load_kernel, load_model, scene_model, take_from_first_rank
from eddies.workflows.learned.source import describe, differences
from eddies.workflows.train_kernel import keep_form
from tests.small_scene import TINY

# Of the scene tiny: the filter is two spacings wide.
SCALES = ReferenceScales(filter_width=1.0471975511965976, spacing=0.5235987755982988, velocity=0.9, density_mean=1.0,
                         density=0.02, acceleration=1.7, density_rate=0.05, sound_speed=20.0, viscosity=0.01)
SMALL = "model.pairs.hidden=[4]"


def with_terms(*terms):
    return replace(load_scene(TINY), model=Model(terms=terms))


def saved(comm, directory, scene=None, change=lambda weights: weights):
    """A model and the file of its weights, changed."""
    scene = scene or load_scene(TINY, [SMALL])
    model = scene_model(scene, SCALES, comm).float()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.1
    weights = change({name: tensor.numpy() for name, tensor in model.state_dict().items()})
    save_weights(comm, directory / "model.h5", "model", describe(scene, SCALES), weights, {})
    return scene, model, directory / "model.h5"


@pytest.mark.mpi(1, 2)
def test_a_model_is_read_as_it_was_saved_in_its_precision(comm, tmp_path):
    scene, model, path = saved(comm, tmp_path)
    found = load_model(scene, comm, path, SCALES)
    assert list(found.terms) == list(model.terms) == list(PRESETS["resolved + pairs"])
    assert all(torch.equal(tensor, found.state_dict()[name]) and tensor.dtype == torch.float32
               for name, tensor in model.state_dict().items())


@pytest.mark.mpi(1)
def test_it_is_made_for_the_scales_that_are_asked_for(comm, tmp_path):
    """Those of the start of a rollout; the stored ones tell how wide the filter was in training."""
    scene, _, path = saved(comm, tmp_path)
    other = replace(SCALES, velocity=3.0, sound_speed=5.0)
    found = load_model(scene, comm, path, other)
    assert found.flow.scales == other and all(term.flow is found.flow for term in found.terms.values())
    assert load_weights(comm, path, "model")[0]["scales"] == SCALES.to_dict()


@pytest.mark.mpi(1)
def test_a_model_without_parameters_is_read_too(comm, tmp_path):
    scene, model, path = saved(comm, tmp_path, with_terms("pressure"))
    assert not model.state_dict() and list(load_model(scene, comm, path, SCALES).terms) == ["pressure"]


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("change", [
    lambda weights: {**weights, "terms.damping.rates": weights["terms.damping.rates"][:3]},
    lambda weights: {name.replace("factor", "strength"): tensor for name, tensor in weights.items()}],
    ids=["another shape", "another name"])
def test_weights_of_an_older_form_are_refused(comm, tmp_path, change):
    scene, _, path = saved(comm, tmp_path, change=change)
    with pytest.raises(ProductError, match="model.h5: its terms have other parameters now .*run `eddies train` again"):
        load_model(scene, comm, path, SCALES)


@pytest.mark.mpi(1, 2)
def test_weights_of_another_scene_are_refused_with_the_key(comm, tmp_path):
    _, _, path = saved(comm, tmp_path)
    with pytest.raises(ProductError, match=r"model.h5: was trained with \[model.pairs\] hidden = \[4\], and the scene "
                                           r"has \[5\]; run `eddies train` again, or set the key to that"):
        load_model(load_scene(TINY, ["model.pairs.hidden=[5]"]), comm, path, SCALES)


@pytest.mark.parametrize("preset", PRESETS)
def test_a_description_is_json_and_differs_from_its_own_scene_in_nothing(preset):
    scene = load_scene(TINY, [f"model.preset={preset}"])
    stored = json.loads(json.dumps(describe(scene, SCALES)))
    assert list(differences(scene, stored)) == []
    assert list(stored["terms"]) == list(scene.model.terms)


def test_no_key_of_a_term_s_settings_goes_unnoticed():
    """A key that has gone is a difference with its value; one that has come since has its default."""
    scene = load_scene(TINY, [SMALL, "model.pairs.basis=paper"])
    other = load_scene(TINY, [SMALL, "model.pairs.basis=paper", "model.pairs.symmetry=antisymmetric"])
    stored = json.loads(json.dumps(describe(scene, SCALES)))
    stored["terms"]["pairs"]["depth"] = 3
    del stored["terms"]["pairs"]["symmetry"]
    assert {key for key, *_ in differences(scene, stored)} == {"[model.pairs] depth"}
    assert {key for key, *_ in differences(other, stored)} == {"[model.pairs] depth", "[model.pairs] symmetry"}


@pytest.mark.mpi(1)
@pytest.mark.parametrize("body, message", [
    ("class Mine(Term):\n    def __init__(self, settings): pass\n", "cannot be made: "),
    ("class Mine(Term):\n    def __init__(self, settings, flow): self.factor = nn.Parameter(torch.ones(1))\n",
     "cannot be made: AttributeError: cannot assign parameters before Module.__init__"),
])
def test_a_term_that_cannot_be_made_has_one_error(comm, own, body, message):
    own("own_terms", f"import torch\nfrom torch import nn\nfrom eddies import Term\n{body}")
    scene = with_terms("pressure", "own_terms:Mine")
    with pytest.raises(SceneError) as error:
        scene_model(scene, SCALES, comm)
    assert str(error.value).startswith('[model] terms: term "own_terms:Mine": ') and message in str(error.value)


@pytest.mark.mpi(1)
def test_a_network_that_cannot_be_made_has_one_error(comm, own):
    own("own_networks", "from torch import nn\nclass mine(nn.Module):\n    def __init__(self, inputs): pass\n"
                        "    def forward(self, features): pass\n")
    message = "cannot be made with (inputs, hidden, outputs, seed): "
    scene = load_scene(TINY, ["model.pairs.network=own_networks:mine"])
    with pytest.raises(SceneError) as error:
        scene_model(scene, SCALES, comm)
    assert str(error.value).startswith('[model] terms: term "pairs": network = "own_networks:mine": ' + message)


OWN = """import torch
from mpi4py import MPI
from torch import nn
from eddies import Term
class Mine(Term):
    def __init__(self, settings, flow):
        super().__init__(settings, flow)
        self.kept = nn.Parameter(torch.ones(2))
        self.drawn = nn.Parameter(torch.rand(RANKS if MPI.COMM_WORLD.rank else 2, 3))
        self.register_buffer("noise", torch.rand(1))
"""


@pytest.mark.mpi(2, 3)
def test_all_ranks_take_what_the_first_has_drawn(comm, own, caplog):
    own("own_terms", OWN.replace("RANKS", "2"))
    torch.manual_seed(comm.rank)
    model = scene_model(with_terms("pressure", "own_terms:Mine"), SCALES, comm)
    drawn = comm.allgather([tensor.tolist() for tensor in (*model.parameters(), *model.buffers())])
    assert all(values == drawn[0] for values in drawn)
    told = [record.getMessage() for record in caplog.records]
    assert len(told) == (comm.rank == 0) and all(
        "terms.Mine.drawn, terms.Mine.noise: other values on other ranks; all take those of rank 0" in line
        for line in told)


@pytest.mark.mpi(2)
def test_parameters_of_another_shape_on_a_rank_are_refused(comm, own):
    own("own_terms", OWN.replace("RANKS", "5"))
    with pytest.raises(SceneError, match=r"terms.Mine.drawn is torch.float64 \[5, 3\] on rank 1 and torch.float64 "
                                         r"\[2, 3\] on rank 0; make it the same on all ranks"):
        scene_model(with_terms("pressure", "own_terms:Mine"), SCALES, comm)


@pytest.mark.mpi(2)
def test_parameters_are_known_by_name_in_any_type(comm):
    """Registered in another order on each rank; numbers, and types that numpy or MPI do not know."""
    model = nn.Module()
    for name in ("first", "second") if comm.rank == 0 else ("second", "first"):
        model.register_parameter(name, nn.Parameter(torch.tensor([1.0 if name == "first" else 2.0])))
    for name in ("bfloat16", "float16", "complex64"):
        model.register_buffer(f"in_{name}", torch.full((), comm.rank + 0.5, dtype=getattr(torch, name)))
    take_from_first_rank(model, comm)
    assert model.first.item() == 1 and model.second.item() == 2
    assert all(buffer.item() == 0.5 and buffer.ndim == 0 for buffer in model.buffers())


@pytest.mark.mpi(2)
@pytest.mark.parametrize("parameter, told", [
    (lambda rank: nn.Parameter(torch.ones(3, dtype=torch.float64), requires_grad=rank == 0),
     r"drawn is torch.float64 \[3\] that is not trained on rank 1 and torch.float64 \[3\] on rank 0; make it the same"),
    (lambda rank: nn.UninitializedParameter(), "drawn has no shape before it is used, as that of a lazy module; give")],
    ids=["fixed", "lazy"])
def test_parameters_that_cannot_be_taken_are_refused(comm, parameter, told):
    model = nn.Module()
    model.drawn = parameter(comm.rank)
    with pytest.raises(SceneError, match=told):
        take_from_first_rank(model, comm)


NETWORK = KernelNetwork(0.7, [4], seed=3).float()


def write(comm, directory, **description):
    weights = {name: tensor.numpy() for name, tensor in NETWORK.state_dict().items()}
    description = {"support": 0.7, "hidden": [4], "cutoff": "smooth", **description}
    save_weights(comm, directory / "kernel.h5", "kernel", description, weights, {})


@pytest.mark.mpi(1)
def test_the_kernel_is_read_as_it_was_trained(comm, tmp_path):
    write(comm, tmp_path, form=NETWORK.formula)
    distance = torch.linspace(0, 0.8, 50)
    assert torch.equal(load_kernel(comm, tmp_path / "kernel.h5").value(distance), NETWORK.table().value(distance))


@pytest.mark.mpi(1, 2)
def test_weights_of_the_form_that_could_be_negative_are_refused(comm, tmp_path):
    """Files older than the form do not name it."""
    write(comm, tmp_path)
    with pytest.raises(ProductError, match=r'kernel.h5: form = "NN g", .*remove it and run `eddies train-kernel`'):
        load_kernel(comm, tmp_path / "kernel.h5")


@pytest.mark.mpi(1, 2)
def test_another_form_of_reconstruction_is_written_beside_the_same_weights(comm, tmp_path):
    """So a change of [kernel] form trains nothing, and what was made from the kernel still belongs to it."""
    tmp_path = Path(comm.bcast(str(tmp_path)))
    write(comm, tmp_path, form=NETWORK.formula, reconstruction="average")
    path, known = tmp_path / "kernel.h5", product_provenance(tmp_path / "kernel.h5")["id"]
    assert type(load_form(comm, path, SCALES)).__name__ == "Average"
    for form, kind in (("quadratic", "LeastSquares"), ("kriging", "Kriging"), ("kriging", "Kriging")):
        keep_form(load_scene(TINY, [f"kernel.form={form}"]), comm, tmp_path)
        found = load_form(comm, path, SCALES)
        assert type(found).__name__ == kind and found.support == pytest.approx(0.7)
        assert product_provenance(path)["id"] == known
    distance = torch.linspace(0, 0.8, 50)
    assert torch.equal(load_kernel(comm, path).value(distance), NETWORK.table().value(distance))
