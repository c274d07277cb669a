"""Particles moved by forces between them, learned or of SPH, or by none."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from eddies.parallel.broadcast import first_complaint
from eddies.parallel.halo import HaloError
from eddies.particles.body_forces import LinearForcing
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.faults import Limits, find_fault
from eddies.particles.feature_range import FeatureRange, pair_features
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.pair_forces import PairModel
from eddies.particles.particle_set import ParticleSet
from eddies.particles.smoothing_kernels import CubicSpline, WendlandC2
from eddies.particles.term_protocols import DensityClosure, PairTerm
from eddies.particles.wcsph import WCSPH, SummationDensity
from eddies.scene import Scene, Wcsph
from eddies.workflows.closures import density_closure
from eddies.workflows.estimates import ALLOWED_VELOCITY
from eddies.workflows.trained_model import load_feature_range, load_model
from eddies.workflows.truth import GroundTruth

# A state is runaway, not turbulence, when a particle is this many times faster, or its density this many times
# farther from the mean, than the rms of the truth.
RUNAWAY_SPEED, RUNAWAY_DENSITY = 30.0, 300.0
SPH_KERNELS = {"cubic-spline": CubicSpline, "wendland": WendlandC2}


@dataclass(frozen=True)
class Force:
    """What acts between particles: pair terms, and the closure that gives their density or None.

    `largest_deviation`: of a particle's density from the mean, in a sound state. `description`: for the product.
    `learned`: a trained model and the range of what it was given in training, where that is known.
    """

    terms: list[PairTerm] = field(default_factory=list)
    closure: DensityClosure | None = None
    largest_deviation: float = np.inf
    description: dict[str, float | str] = field(default_factory=lambda: {"closure": "none"})
    learned: tuple[PairModel, FeatureRange] | None = None


class ParticleRun:
    """The particles of a frame of the ground truth, with the force that [simulation] force names."""

    def __init__(self, scene: Scene, truth: GroundTruth, start: int, directory: Path, device: torch.device) -> None:
        self.settings, self.comm, scales = scene.simulation, truth.decomposition.comm, truth.scales
        self.force = FORCES[self.settings.force](scene, truth, directory, device)
        self.dynamics = build_dynamics(scene, truth, self.force)
        self.integrator = INTEGRATORS[self.settings.integrator](self.dynamics)
        self.particles = ParticleSet.from_numpy(truth.particles(start), device)
        self.limits = Limits(RUNAWAY_SPEED * scales.velocity, scales.density_mean, self.force.largest_deviation)
        self._shares_outside: list[float] = []

    def steps(self, interval: float) -> int:
        """As many steps as are no longer than that of the scene."""
        return max(int(np.ceil(interval / self.settings.step - 1e-9)), 1)

    def advance(self, step: float, number: int) -> str | None:
        """Take a step; what is wrong with the state after it, on all ranks, or None."""
        try:
            self.particles = self.integrator.step(self.particles, step)
        except HaloError as error:  # on all ranks alike: particles outrun the halo
            return f"step {number}: {error}"
        fault = find_fault(self.particles, self.limits, self.dynamics.box, number, self.comm.rank)
        return first_complaint(self.comm, fault)

    def frame(self) -> tuple[ParticleSet, torch.Tensor]:
        """The particles, with the density of the closure if there is one, and their acceleration."""
        particles, _ = self.dynamics.settle(self.particles)
        rates = self.dynamics.rates(particles)
        particles = replace(particles, density=rates.get("closure_density", particles.density))
        if self.force.learned is not None:
            model, seen = self.force.learned
            blocks = pair_features(model, self.dynamics.surroundings, particles, self.dynamics.dtype)
            self._shares_outside.append(seen.share_outside(self.comm, blocks))
        return particles, rates["velocity"]

    def series(self) -> dict[str, dict[str, list[float]]]:
        """`outside_training`: the share of pairs that give the network inputs outside the range of its training."""
        return {} if self.force.learned is None else {"outside_training": {"share": self._shares_outside}}

    def description(self) -> dict[str, float | str]:
        """Integrator and force."""
        return {"integrator": self.settings.integrator, **self.force.description}


def no_force(scene: Scene, truth: GroundTruth, directory: Path, device: torch.device) -> Force:
    """No term: neither neighbour list nor messages, and particles that keep their velocity."""
    return Force()


def learned_force(scene: Scene, truth: GroundTruth, directory: Path, device: torch.device) -> Force:
    """The trained model of a run directory."""
    settings, slab, scales = scene.simulation, truth.decomposition, truth.scales
    dtype = getattr(torch, settings.precision)
    model = load_model(slab.comm, directory / "model.h5", device).to(dtype)
    drift = ALLOWED_VELOCITY * scales.velocity * settings.step
    closure = density_closure(model, slab, dtype, settings.skin * model.cutoff, drift)
    seen = load_feature_range(slab.comm, directory / "model.h5") if model.pair_terms else None
    return Force(model.pair_terms, closure, RUNAWAY_DENSITY * scales.density,
                 {"basis": model.basis, "closure": model.closure}, None if seen is None else (model, seen))


def smoothed_particles(scene: Scene, truth: GroundTruth, directory: Path, device: torch.device) -> Force:
    """WCSPH with the fluid's sound speed; the density of a random particle deviates from the mean without a fault."""
    form, scales = scene.wcsph or Wcsph(), truth.scales
    kernel = SPH_KERNELS[form.kernel](scene.kernel.support(truth.total))
    mass = scales.density_mean * truth.decomposition.length**3 / truth.total
    term = WCSPH(kernel, mass, scales.density_mean, scales.sound_speed, form.alpha, form.beta, form.exponent)
    closure = SummationDensity(kernel, mass, getattr(torch, scene.simulation.precision))
    return Force([term.to(device)], closure, description={"closure": "summation", **asdict(form)})


FORCES = {"learned": learned_force, "none": no_force, "wcsph": smoothed_particles}


def build_dynamics(scene: Scene, truth: GroundTruth, force: Force) -> ParticleDynamics:
    """The force between particles, and the forcing of the large scales if there is one."""
    settings, slab = scene.simulation, truth.decomposition
    terms = list(force.terms)
    if settings.injection != "none":
        terms.append(LinearForcing(injection_rate(scene, truth), forced_below(scene), slab.comm, slab.length))
    skin = settings.skin * scene.kernel.support(truth.total)
    return ParticleDynamics(slab, slab.length, terms, skin, force.closure, getattr(torch, settings.precision))


def injection_rate(scene: Scene, truth: GroundTruth) -> float:
    """Power per mass of the forcing: as given, the dissipation rate of the ground truth, or zero."""
    named = {"none": 0.0, "dissipation": truth.reference["dissipation_rate"]}
    injection = scene.simulation.injection
    return named.get(injection, injection)


def forced_below(scene: Scene) -> float:
    """Modes with 0 < |k| < this are forced."""
    return scene.forcing.wavenumber if scene.forcing else 2.0
