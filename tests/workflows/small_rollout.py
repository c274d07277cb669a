"""A small scene with all products that a rollout starts from, and methods of a user."""

from dataclasses import replace

import numpy as np

from eddies.io.weights import save_weights
from eddies.particles.smoothing_kernels import KernelNetwork
from eddies.scene.scene import load_scene
from eddies.workflows import dns
from eddies.workflows.ground_truth.truth import open_truth
from eddies.workflows.learned.model import initial_model
from eddies.workflows.learned.source import ModelDefinition
from eddies.workflows.run_directory.fingerprints import stage_provenance

SCENE = """
[flow]
fluid = "{fluid}"
cells = 12
viscosity = 0.1
{sound}
[tracers]
particles_per_side = {side}
turnovers = {turnovers}
frame_interval = 0.02
field_every = 1
field_cells = 8
[kernel]
neighbors = 20
steps = 1
{model}
[training]
window = 1
frames = 2
batch = 60
steps = 4
combined_steps = 2
field_weight = 0.1
[training.horizons]
steps = 1
frames = [1]
[simulation]
step = 0.02
turnovers = 0.05
frame_interval = 0.04
start = {start}
"""
MODEL = '[model]\npreset = "resolved + pairs"\n[model.pairs]\ninputs = ["density", "distance", "speed", "approach"]'
# A method that moves all particles with the same wind. It has no state_dict.
OWN_METHOD = """
import torch

from eddies.particles.particle_set import ParticleSet


class Swept:
    needs = ()
    has_density = False

    def __init__(self, scene, truth, start, directory, device):
        self.time = 0.0
        self.length, self.wind = truth.decomposition.length, torch.tensor([0.5, 0.0, -1.0], dtype=torch.float64)
        columns = truth.particles(start)
        columns.pop("density", None)
        self.particles = ParticleSet.from_numpy(columns)

    def advance(self, until, number):
        step = min(until - self.time, 0.03)
        moved = (self.particles.position + step * self.wind) % self.length
        velocity = self.wind.expand_as(moved).contiguous()
        self.particles = ParticleSet(self.particles.id, moved, velocity)
        self.time += step

    def frame(self, time):
        assert abs(time - self.time) < 1e-12
        return self.particles, torch.zeros_like(self.particles.velocity)

    def status(self):
        return "  the wind blows"

    def series(self):
        return {"wind": {"strength": []}}

    def description(self):
        return {"integrator": "exact", "terms": "wind"}
"""


def scene_text(fluid="compressible", model=MODEL, start=0.3, turnovers=0.14, side=6):
    sound = "sound_speed = 15.0" if fluid == "compressible" else ""
    return SCENE.format(fluid=fluid, sound=sound, model=model, start=start, turnovers=turnovers, side=side)


def prepared(comm, directory, *args, overrides=(), removals=(), **keys):
    """The scene, with its ground truth and, with [kernel], an untrained kernel in a directory."""
    path = directory / "own.toml"
    if comm.rank == 0:
        directory.mkdir(parents=True, exist_ok=True)
        path.write_text(scene_text(*args, **keys))
    comm.Barrier()
    scene = load_scene(path, overrides, removals)
    dns.run(scene, comm, directory)
    if scene.kernel:
        write_kernel(comm, directory, scene)
    return scene


def write_kernel(comm, directory, scene):
    """The kernel with initial weights."""
    network = KernelNetwork(scene.tracers.radius_of(scene.kernel.neighbors), [4])
    description = {"form": network.formula, "support": network.support, "hidden": [4], "cutoff": "smooth"}
    weights = {name: tensor.numpy() for name, tensor in network.state_dict().items()}
    save_weights(comm, directory / "kernel.h5", "kernel", description, weights,
                 stage_provenance(scene, "train-kernel"), {"history": {"step": np.zeros(1)}})


def scales_of(comm, directory):
    """The scales of the ground truth in a directory."""
    with open_truth(comm, directory / "ground_truth.h5") as truth:
        return truth.scales


def write_model(comm, directory, scene, scales, bound=1e3, features=5):
    """The model with initial parameters; all its inputs occurred in training up to a bound."""
    definition = ModelDefinition.of(scene)
    weights = {name: tensor.float().numpy()
               for name, tensor in initial_model(definition, scales, comm).state_dict().items()}
    ranges = {"low": np.full(features, -bound), "high": np.full(features, bound)}
    save_weights(comm, directory / "model.h5", "model", definition.describe(scales), weights, {},
                 {"feature_range": ranges})


def with_method(scene, method, **keys):
    """The scene with another method of its rollout, and other keys of [simulation]."""
    return replace(scene, simulation=replace(scene.simulation, method=method, **keys))
