"""Models, scales and a recorder of gradients for the tests of this folder."""

import numpy as np
import torch

from eddies.parallel.reduction import global_sum
from eddies.particles.flow_units import FlowUnits, ReferenceScales
from eddies.particles.model import build_model
from eddies.scene.model import Model

LENGTH, PER_SIDE = 2 * np.pi, 12
SPACING = LENGTH / PER_SIDE
SCALES = ReferenceScales(filter_width=2 * SPACING, spacing=SPACING, velocity=1.0, density_mean=1.0, density=0.01,
                         acceleration=1.0, density_rate=0.02, sound_speed=10.0, viscosity=0.01)


def model_of(preset, support, neighbors, hidden):
    """The model of a preset, of terms or of settings by term, in double precision, with networks of these widths."""
    listed = {"preset": preset} if isinstance(preset, str) else {"terms": tuple(preset)}
    settings = preset if isinstance(preset, dict) else {}
    widths = {name: {"hidden": hidden} for name, declared in Model(**listed).settings.items()
              if hasattr(declared, "hidden")}
    wanted = Model(**listed, settings={name: {**widths.get(name, {}), **settings.get(name, {})}
                                       for name in widths | settings})
    return build_model(wanted.settings, wanted.terms, FlowUnits(SCALES, support, neighbors, seed=2))


class Recorder:
    """An optimizer that takes no step but keeps the gradient, summed over ranks."""

    def __init__(self, comm, model):
        self.comm, self.model = comm, model

    def step(self, share):
        self.model.zero_grad()
        share.backward()
        parts = [torch.zeros_like(p) if p.grad is None else p.grad for p in self.model.parameters()]
        self.gradient = global_sum(self.comm, torch.cat([part.flatten() for part in parts]).numpy())
        return 0.0


def slope(model, loss, gradient, epsilon):
    """Derivative of a loss in a random direction of all parameters: by central differences, and by the gradient."""
    random = np.random.default_rng(1)
    direction = [torch.from_numpy(np.asarray(random.standard_normal(p.shape))) for p in model.parameters()]
    values = []
    with torch.no_grad():
        for sign in (1, -2):
            for parameter, part in zip(model.parameters(), direction):
                parameter += sign * epsilon * part
            values.append(loss())
        for parameter, part in zip(model.parameters(), direction):
            parameter += epsilon * part
    return (values[0] - values[1]) / (2 * epsilon), gradient @ torch.cat([part.flatten() for part in direction]).numpy()
