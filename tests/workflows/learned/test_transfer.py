"""A trained model on another flow."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from eddies.io.weights import StoredWeights, save_weights
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.flow_units import ReferenceScales
from eddies.particles.particle_set import ParticleSet
from eddies.scene.scene import BOX_LENGTH, load_scene
from eddies.workflows.learned.model import initial_model, load_model
from eddies.workflows.learned.source import ModelDefinition
from eddies.workflows.learned.transfer import trained_on
from tests.small_scene import TINY

# The filter width is two spacings, as in the scene tiny.
SCALES = ReferenceScales(filter_width=BOX_LENGTH / 6, spacing=BOX_LENGTH / 12, velocity=0.9, density_mean=1.0,
                         density=0.02, acceleration=1.7, density_rate=0.05, sound_speed=11.0, viscosity=0.01)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("preset, weight", [("paper", 1e-5), ("resolved + pairs", 1e-4), ("resolved", 1e-6)])
def test_the_same_flow_in_other_units_gets_the_same_force_in_those_units(comm, tmp_path, preset, weight):
    """Twice as fast, and with four times the fluctuations of density at the same speed of sound."""
    definition = ModelDefinition.of(load_scene(TINY, [f"model.preset={preset}"]))
    model = initial_model(definition, SCALES, comm).float()
    weights = {name: tensor.numpy() for name, tensor in model.state_dict().items()}
    other = replace(SCALES, velocity=1.8, density=0.08, acceleration=6.8, density_rate=0.4,
                    viscosity=2 * SCALES.viscosity)
    save_weights(comm, tmp_path / "model.h5", "model", definition.describe(SCALES), weights, {})
    adopted = load_model(definition, comm, tmp_path / "model.h5", other)
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
