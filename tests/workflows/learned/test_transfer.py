"""A trained model on another flow."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from eddies.parallel.slab import SlabDecomposition
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.flow_units import ReferenceScales
from eddies.particles.particle_set import ParticleSet
from eddies.scene.scene import BOX_LENGTH, load_scene
from eddies.workflows.learned.model import scene_model, with_weights
from eddies.workflows.learned.source import ModelSource, describe
from eddies.workflows.learned.transfer import trained_on
from tests.small_scene import TINY

# Of the scene tiny: filter width two spacings, whatever their number.
SCALES = ReferenceScales(filter_width=BOX_LENGTH / 6, spacing=BOX_LENGTH / 12, velocity=0.9, density_mean=1.0,
                         density=0.02, acceleration=1.7, density_rate=0.05, sound_speed=11.0, viscosity=0.01)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("preset, weight", [("paper", 1e-5), ("resolved + pairs", 1e-4), ("resolved", 1e-6)])
def test_the_same_flow_in_other_units_gets_the_same_force_in_those_units(comm, preset, weight):
    """Twice as fast, and with four times the fluctuations of density at the same speed of sound."""
    scene = load_scene(TINY, [f"model.preset={preset}"])
    model = scene_model(scene, SCALES, comm).float()
    weights = {name: tensor.numpy() for name, tensor in model.state_dict().items()}
    other = replace(SCALES, velocity=1.8, density=0.08, acceleration=6.8, density_rate=0.4,
                    viscosity=2 * SCALES.viscosity)
    adopted = with_weights(scene, comm, json.loads(json.dumps(describe(scene, SCALES))), weights, "model.h5", other)
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


def test_weights_that_go_from_run_to_run_keep_where_they_were_trained():
    scene, errors = load_scene(TINY, ["model.path=runs/first"]), {"a_priori": {"acceleration_error": 0.3}}
    first = ModelSource(Path("first"), {}, {}, errors, {"mach_turbulent": 0.08})
    origin, own = trained_on(scene, first)
    assert origin == {"path": "runs/first", "mach_turbulent": 0.08} and own == errors["a_priori"]

    # On another flow alone: not on that of the run, of which are Mach number and errors.
    elsewhere = {"mach_turbulent": 0.08, "made_from": {"ground_truth": "t1"},
                 "truths": {"runs/a/ground_truth.h5": "t2"}, "mach_of_truths": {"runs/a/ground_truth.h5": 0.04}}
    found = trained_on(scene, ModelSource(Path("first"), {}, {}, errors, elsewhere))
    assert found == ({"path": "runs/first", "truths": {"runs/a/ground_truth.h5": 0.04}}, None)
    second = ModelSource(Path("second"), {}, {}, errors, {"mach_turbulent": 0.16, "source": found[0]})
    assert trained_on(load_scene(TINY, ["model.path=runs/second"]), second) == found

    tables = {"a_priori": {"acceleration_error": 0.5}, "source_a_priori": own}
    second = ModelSource(Path("second"), {}, {}, tables, {"mach_turbulent": 0.16, "source": origin})
    assert trained_on(load_scene(TINY, ["model.path=runs/second"]), second) == (origin, own)
