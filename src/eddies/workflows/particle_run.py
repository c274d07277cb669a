"""Particles moved by the terms of a model, learned or of SPH, or by none."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch

from eddies.parallel.broadcast import first_complaint
from eddies.parallel.halo import HaloError
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.faults import Limits, find_fault
from eddies.particles.feature_range import FeatureRange, pair_features
from eddies.particles.flow_units import FlowUnits
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.model import LagrangianModel, build_model
from eddies.particles.particle_set import ParticleSet
from eddies.particles.terms.forcing import Forcing
from eddies.particles.terms.presets import PRESETS
from eddies.particles.terms.settings import SummationDensity, WCSPH
from eddies.scene import Scene, Wcsph
from eddies.workflows.estimates import ALLOWED_VELOCITY
from eddies.workflows.trained_model import load_feature_range, load_model
from eddies.workflows.truth import GroundTruth, particles_for

# A state is runaway, not turbulence, when a particle is this many times faster, or its density this many times
# farther from the mean, than the rms of the truth.
RUNAWAY_SPEED, RUNAWAY_DENSITY = 30.0, 300.0


class ParticleRun:
    """The particles of a frame of the ground truth, moved by a model.

    Its units are the scales of the flow at that frame: nothing is measured after it. A subclass says which model it is
    (`build`), and how far a particle's density may deviate from the mean in a sound state (`largest_deviation`).
    """

    largest_deviation = np.inf
    seen: FeatureRange | None = None

    def __init__(self, scene: Scene, truth: GroundTruth, start: int, directory: Path, device: torch.device) -> None:
        self.settings, self.comm, self.scales = scene.simulation, truth.decomposition.comm, truth.scales_at(start)
        self.flow = FlowUnits(self.scales, scene.kernel.support(truth.total), scene.kernel.neighbors, scene.seed)
        dtype = getattr(torch, self.settings.precision)
        self.model = self.with_forcing(self.build(scene, directory), scene, truth).to(dtype=dtype, device=device)
        drift = ALLOWED_VELOCITY * self.scales.velocity * self.settings.step
        self.dynamics = ParticleDynamics(truth.decomposition, self.model, self.settings.skin * self.flow.cutoff, dtype,
                                         drift)
        self.integrator = INTEGRATORS[self.settings.integrator](self.dynamics)
        self.particles = particles_for(self.model, truth.particles(start), device)
        self.limits = Limits(RUNAWAY_SPEED * self.scales.velocity, self.scales.density_mean, self.largest_deviation)
        self._shares_outside: list[float] = []

    def build(self, scene: Scene, directory: Path) -> LagrangianModel:
        """The model, without forcing; collective."""
        raise NotImplementedError

    def with_forcing(self, model: LagrangianModel, scene: Scene, truth: GroundTruth) -> LagrangianModel:
        """The model with the forcing of the large scales that a simulation asks for, if it asks for any."""
        if self.settings.injection == "none":
            return model
        settings = Forcing.Settings(injection_rate=injection_rate(scene, truth), wavenumber=forced_below(scene))
        return LagrangianModel({**model.terms, "injection": Forcing(settings, self.flow)}, self.flow)

    @property
    def has_density(self) -> bool:
        """Whether the particles of its frames have a density."""
        return self.model.reads_density

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
        """The particles, with the density that terms give if they do, and their acceleration."""
        particles, _ = self.dynamics.settle(self.particles)
        rates = self.dynamics.rates(particles)
        if rates.density is not None:
            particles = replace(particles, density=rates.density)
        if self.seen is not None:
            self._shares_outside.append(self.seen.share_outside(self.comm, pair_features(self.dynamics, particles)))
        return particles, rates.acceleration

    def series(self) -> dict[str, dict[str, list[float]]]:
        """`outside_training`: the share of pairs that give the networks inputs outside the range of their training."""
        return {} if self.seen is None else {"outside_training": {"share": self._shares_outside}}

    def description(self) -> dict[str, float | str]:
        """Integrator and terms."""
        return {"integrator": self.settings.integrator, "terms": ", ".join(self.model.terms) or "none"}


class LearnedRun(ParticleRun):
    """Moved by the trained model of the run directory."""

    def build(self, scene: Scene, directory: Path) -> LagrangianModel:
        path = directory / "model.h5"
        model = load_model(scene, self.comm, path, self.scales)
        if self.scales.density is not None:
            self.largest_deviation = RUNAWAY_DENSITY * self.scales.density
        if model.networks:
            self.seen = load_feature_range(self.comm, path)
        return model


class BallisticRun(ParticleRun):
    """Not moved by anything: particles keep their velocity. Neither neighbour list nor messages."""

    def build(self, scene: Scene, directory: Path) -> LagrangianModel:
        return LagrangianModel({}, self.flow)


class SmoothedRun(ParticleRun):
    """Moved by weakly compressible SPH with the fluid's sound speed. The summed density of particles at random deviates
    far from the mean without a fault."""

    def build(self, scene: Scene, directory: Path) -> LagrangianModel:
        form = scene.wcsph or Wcsph()
        settings = {"summation-density": SummationDensity(kernel=form.kernel), "wcsph": WCSPH(**asdict(form))}
        return build_model(settings, PRESETS["wcsph"], self.flow)

    def description(self) -> dict[str, float | str]:
        """The coefficients too."""
        return {**super().description(), **asdict(self.model.terms["wcsph"].settings)}


def injection_rate(scene: Scene, truth: GroundTruth) -> float:
    """Power per mass of the forcing: as given, the dissipation rate of the ground truth, or zero."""
    named = {"none": 0.0, "dissipation": truth.reference["dissipation_rate"]}
    injection = scene.simulation.injection
    return named.get(injection, injection)


def forced_below(scene: Scene) -> float:
    """Modes with 0 < |k| < this are forced."""
    return scene.forcing.wavenumber if scene.forcing else 2.0
