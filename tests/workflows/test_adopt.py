"""A trained model on another flow."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import torch

from eddies.particles.neighbor_list import NeighborList
from eddies.particles.pair_forces import PairModel
from eddies.particles.periodic_box import PeriodicBox
from eddies.particles.reference_scales import ReferenceScales
from eddies.scene import BOX_LENGTH, load_scene
from eddies.workflows.adopt import adopted_model, trained_on
from eddies.workflows.model_source import ModelSource

SCALES = ReferenceScales(length=1.2, spacing=0.6, velocity=0.9, density_mean=1.0, density=0.02, acceleration=1.7,
                         density_rate=0.05, sound_speed=11.0, viscosity=0.01)


def rates(model, position, velocity, density):
    listed = NeighborList(PeriodicBox(BOX_LENGTH), model.cutoff, 0.0)
    listed.build(position, position, exclude_self=True)
    return model(listed.pairs(position, position, dtype=torch.float32), {"velocity": velocity, "density": density})


def test_the_same_flow_in_other_units_gets_the_same_force_in_those_units():
    scene = load_scene("tiny")
    support = scene.kernel.support(scene.tracers.particles)
    model = PairModel(SCALES, support, scene.kernel.neighbors, seed=5).float()
    source = ModelSource(Path("model.h5"), model.state_description(),
                         {name: tensor.numpy() for name, tensor in model.state_dict().items()}, {}, {})
    # Twice as fast, with a third of the fluctuations of density.
    other = replace(SCALES, velocity=1.8, density=0.02 / 3, acceleration=3.4, density_rate=0.05 / 3)
    adopted = adopted_model(scene, source, SimpleNamespace(scales=other))
    assert adopted.scales == other and adopted.cutoff == support
    assert next(adopted.parameters()).dtype == torch.float32

    generator = torch.manual_seed(2)
    position = BOX_LENGTH * torch.rand(150, 3, dtype=torch.float64, generator=generator)
    velocity = torch.randn(150, 3, dtype=torch.float64, generator=generator)
    contrast = 0.02 * torch.randn(150, dtype=torch.float64, generator=generator)
    expected = rates(model, position, velocity, 1 + contrast)["velocity"]
    found = rates(adopted, position, 2 * velocity, 1 + contrast / 3)["velocity"]
    assert expected.norm() > 1
    # Single precision.
    assert (found - 2 * expected).norm() < 1e-5 * found.norm()


def test_weights_that_go_from_run_to_run_keep_where_they_were_trained():
    scene, errors = load_scene("tiny", ["model.path=runs/first"]), {"a_priori": {"acceleration_error": 0.3}}
    first = ModelSource(Path("first"), {}, {}, errors, {"mach_turbulent": 0.08})
    origin, own = trained_on(scene, first)
    assert origin == {"path": "runs/first", "mach_turbulent": 0.08} and own == errors["a_priori"]

    tables = {"a_priori": {"acceleration_error": 0.5}, "source_a_priori": own}
    second = ModelSource(Path("second"), {}, {}, tables, {"mach_turbulent": 0.16, "source": origin})
    assert trained_on(load_scene("tiny", ["model.path=runs/second"]), second) == (origin, own)
