"""Models and kernels with the weights of a file: what is stored, read and refused, and equality between ranks."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import nn

from eddies.io.hdf5 import ProductError
from eddies.io.provenance import product_provenance
from eddies.io.weights import load_weights, save_weights
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.flow_units import ReferenceScales
from eddies.particles.particle_set import ParticleSet
from eddies.particles.smoothing_kernels import KernelNetwork
from eddies.scene.scene import BOX_LENGTH, Model, SceneError, load_scene
from eddies.scene.terms import PRESETS
from eddies.workflows.learned.model import initial_model, load_form, take_from_first_rank, trained_model
from eddies.workflows.learned.source import ModelDefinition
from eddies.workflows.run_directory.fingerprints import stage_provenance
from eddies.workflows.train_kernel import keep_form
from tests.small_scene import TINY

# Scales of the scene tiny: the filter is two spacings wide.
SCALES = ReferenceScales(filter_width=1.0471975511965976, spacing=0.5235987755982988, velocity=0.9, density_mean=1.0,
                         density=0.02, acceleration=1.7, density_rate=0.05, sound_speed=20.0, viscosity=0.01)
SMALL = "model.pairs.hidden=[4]"


def definition(*overrides):
    return ModelDefinition.of(load_scene(TINY, [SMALL, *overrides]))


def with_terms(*terms):
    return replace(definition(), model=Model(terms=terms))


def saved(comm, directory, of=None, change=lambda weights: weights):
    """A model and the file of its weights, after a change."""
    of = of or definition()
    model = initial_model(of, SCALES, comm).float()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.1
    weights = change({name: tensor.numpy() for name, tensor in model.state_dict().items()})
    save_weights(comm, directory / "model.h5", "model", of.describe(SCALES), weights, {})
    return of, model, directory / "model.h5"


@pytest.mark.mpi(2)
def test_a_model_is_read_as_it_was_saved_for_the_scales_of_another_flow(comm, tmp_path):
    of, model, path = saved(comm, tmp_path)
    other = replace(SCALES, velocity=3.0, sound_speed=5.0, spacing=2 * SCALES.spacing,
                    filter_width=2 * SCALES.filter_width)
    stored = load_weights(comm, path, "model")
    loaded = trained_model(of, stored, other, comm)
    assert list(loaded.terms) == list(model.terms) == list(PRESETS["resolved + pairs"])
    assert all(torch.equal(tensor, loaded.state_dict()[name]) and tensor.dtype == torch.float32
               for name, tensor in model.state_dict().items())
    assert loaded.flow.cutoff == pytest.approx(2 * model.flow.cutoff)
    assert loaded.flow.scales == other and all(term.flow is loaded.flow for term in loaded.terms.values())
    assert stored.description["scales"] == SCALES.to_dict()


@pytest.mark.mpi(1)
@pytest.mark.parametrize("preset, weight", [("paper", 1e-5), ("resolved + pairs", 1e-4), ("resolved", 1e-6)])
def test_the_same_flow_in_other_units_gets_the_same_force_in_those_units(comm, tmp_path, preset, weight):
    """Twice as fast, and with four times the fluctuations of density at the same speed of sound."""
    of = ModelDefinition.of(load_scene(TINY, [f"model.preset={preset}"]))
    model = initial_model(of, SCALES, comm).float()
    weights = {name: tensor.numpy() for name, tensor in model.state_dict().items()}
    other = replace(SCALES, velocity=1.8, density=0.08, acceleration=6.8, density_rate=0.4,
                    viscosity=2 * SCALES.viscosity)
    save_weights(comm, tmp_path / "model.h5", "model", of.describe(SCALES), weights, {})
    adopted = trained_model(of, load_weights(comm, tmp_path / "model.h5", "model"), other, comm)
    assert adopted.flow.scales == other and adopted.flow.cutoff == model.flow.cutoff
    assert all(parameter.dtype == torch.float32 for parameter in adopted.parameters())

    slab, generator = SlabDecomposition(comm, BOX_LENGTH, 12), torch.manual_seed(2)
    position = BOX_LENGTH * torch.rand(600, 3, dtype=torch.float64, generator=generator)
    velocity = torch.randn(600, 3, dtype=torch.float64, generator=generator)
    contrast = 0.02 * torch.randn(600, dtype=torch.float64, generator=generator)

    def acceleration(model, speed):
        density = 1 + speed**2 * contrast if model.integrates_density else None
        particles = ParticleSet(torch.arange(600), position, speed * velocity, density)
        with torch.no_grad():
            return ParticleDynamics(slab, model, 0.0, torch.float32).rates(particles).acceleration

    expected, found = acceleration(model, 1), acceleration(adopted, 2)
    assert expected.norm() > 1
    # Single precision.
    assert (found - 4 * expected).norm() < weight * found.norm()


@pytest.mark.mpi(2)
def test_weights_of_another_model_are_refused(comm, tmp_path):
    """Weights of another shape or name, or of a scene with another key."""
    for change in (lambda weights: {**weights, "terms.damping.rates": weights["terms.damping.rates"][:3]},
                   lambda weights: {name.replace("factor", "strength"): each for name, each in weights.items()}):
        of, _, path = saved(comm, tmp_path, change=change)
        with pytest.raises(ProductError, match="model.h5: .*parameters do not fit.* `eddies train`"):
            trained_model(of, load_weights(comm, path, "model"), SCALES, comm)
    _, _, path = saved(comm, tmp_path)
    with pytest.raises(ProductError, match=r"model.h5: .*\[model.pairs\] hidden = \[4\], .* \[5\]"):
        trained_model(definition("model.pairs.hidden=[5]"), load_weights(comm, path, "model"), SCALES, comm)


@pytest.mark.parametrize("preset", PRESETS)
def test_a_description_is_json_and_equals_its_own_scene(preset):
    of = ModelDefinition.of(load_scene(TINY, [f"model.preset={preset}"]))
    stored = json.loads(json.dumps(of.describe(SCALES)))
    assert list(of.differences(stored)) == [] and list(stored["terms"]) == list(of.model.terms)


def test_no_key_of_the_settings_of_a_term_goes_unnoticed():
    """A stored key that no longer exists is a difference; a key that is not stored has its default."""
    stored = json.loads(json.dumps(definition("model.pairs.basis=paper").describe(SCALES)))
    stored["terms"]["pairs"]["depth"] = 3
    del stored["terms"]["pairs"]["symmetry"]
    for more, keys in (([], {"depth"}), (["model.pairs.symmetry=antisymmetric"], {"depth", "symmetry"})):
        differences = definition("model.pairs.basis=paper", *more).differences(stored)
        assert {key for key, *_ in differences} == {f"[model.pairs] {key}" for key in keys}


@pytest.mark.mpi(1)
@pytest.mark.parametrize("body, where", [
    ("class Mine(Term):\n    def __init__(self, settings): pass\n", 'term "own:Mine": cannot be made: '),
    ("class Mine(Term):\n    def __init__(self, settings, flow): self.factor = nn.Parameter(torch.ones(1))\n",
     'term "own:Mine": cannot be made: AttributeError: '),
    ("class Mine(nn.Module):\n    def __init__(self, inputs): pass\n    def forward(self, features): pass\n",
     'term "pairs": Mine: TypeError: ')],
    ids=["arguments", "no super", "network"])
def test_a_class_of_the_user_that_cannot_be_made_is_one_error(comm, own, body, where):
    own("own", f"import torch\nfrom torch import nn\nfrom eddies import Term\n{body}")
    of = definition("model.pairs.network=own:Mine") if "pairs" in where else with_terms("pressure", "own:Mine")
    with pytest.raises(SceneError) as error:
        initial_model(of, SCALES, comm)
    assert str(error.value).startswith(f"[model] terms: {where}")
    assert "pairs" not in where or str(error.value).endswith("is called with (inputs, hidden, outputs, seed)")


def parameters(rank):
    """Parameters and buffers that differ between ranks, also of types that numpy or MPI lack."""
    model = nn.Module()
    model.kept = nn.Parameter(torch.ones(2))
    model.drawn = nn.Parameter(torch.full((2, 3), rank + 0.5))
    for name in ("bfloat16", "float16", "complex64"):
        model.register_buffer(f"in_{name}", torch.full((), rank + 0.5, dtype=getattr(torch, name)))
    return model


@pytest.mark.mpi(2)
def test_all_ranks_take_the_values_of_the_first(comm, caplog):
    model = parameters(comm.rank)
    take_from_first_rank(model, comm)
    assert (model.kept == 1).all() and (model.drawn == 0.5).all()
    assert all(buffer.item() == 0.5 and buffer.ndim == 0 for buffer in model.buffers())
    warnings = [record.getMessage() for record in caplog.records]
    assert len(warnings) == (comm.rank == 0)
    assert all("of drawn, in_bfloat16, in_float16, in_complex64 differ" in line for line in warnings)


@pytest.mark.mpi(2)
@pytest.mark.parametrize("drawn, message", [
    (lambda rank: nn.Parameter(torch.ones(3 + rank)), r"rank 1 has drawn torch.float32 \[4\] where"),
    (lambda rank: nn.Parameter(torch.ones(3), requires_grad=rank == 0), "rank 1 has drawn .* not trained where"),
    (lambda rank: nn.UninitializedParameter(), "drawn has no shape"),
    (None, "rank 1 has drawn .* where rank 0 has kept")], ids=["shape", "fixed", "lazy", "order"])
def test_parameters_that_cannot_be_copied_are_refused(comm, drawn, message):
    """Also in another order, because gradients are summed over ranks in the order of the parameters."""
    model = parameters(comm.rank)
    if drawn is not None:
        model.drawn = drawn(comm.rank)
    elif comm.rank == 1:
        model.register_parameter("kept", model._parameters.pop("kept"))
    with pytest.raises(SceneError, match=message):
        take_from_first_rank(model, comm)


NETWORK = KernelNetwork(0.7, [4], seed=3).float()


def write_kernel(comm, directory, **description):
    weights = {name: tensor.numpy() for name, tensor in NETWORK.state_dict().items()}
    description = {"support": 0.7, "hidden": [4], "cutoff": "smooth", **description}
    save_weights(comm, directory / "kernel.h5", "kernel", description, weights, {})


@pytest.mark.mpi(2)
def test_weights_of_the_former_kernel_that_could_be_negative_are_refused(comm, tmp_path):
    """Their files do not name a formula."""
    write_kernel(comm, tmp_path)
    with pytest.raises(ProductError, match='kernel.h5: .* formula "NN g", .*`eddies train-kernel`'):
        load_form(comm, tmp_path / "kernel.h5", SCALES)


@pytest.mark.mpi(1)
def test_a_kernel_with_a_form_of_an_earlier_version_is_refused(comm, tmp_path):
    """The remedy keeps its weights."""
    write_kernel(comm, tmp_path, form=NETWORK.formula, reconstruction="linear")
    with pytest.raises(ProductError, match='kernel.h5: .* form "linear", .*"kriging".*`eddies train-kernel SCENE`'):
        load_form(comm, tmp_path / "kernel.h5", SCALES)


@pytest.mark.mpi(2)
def test_another_form_of_reconstruction_keeps_weights_and_id(comm, tmp_path):
    """A change of [kernel] form trains nothing, and products made with the kernel stay valid."""
    path = Path(comm.bcast(str(tmp_path))) / "kernel.h5"
    write_kernel(comm, path.parent, form=NETWORK.formula, reconstruction="average")
    identity, distance = product_provenance(path)["id"], torch.linspace(0, 0.8, 50)
    assert load_form(comm, path, SCALES).name == "average"
    for form in ("kriging", "average", "average"):
        keep_form(comm, path, form, stage_provenance(load_scene(TINY, [f"kernel.form={form}"]), "train-kernel"))
        loaded = load_form(comm, path, SCALES)
        assert loaded.name == form and loaded.support == pytest.approx(0.7)
        assert product_provenance(path)["id"] == identity
    assert torch.equal(load_form(comm, path, SCALES).kernel.value(distance), NETWORK.table().value(distance))
