"""Particles moved by the terms of a model, or by none."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from eddies.io.checkpoint import Checkpoint
from eddies.parallel.broadcast import first_complaint
from eddies.parallel.halo import HaloError
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.faults import Limits, find_fault
from eddies.particles.feature_range import FeatureRange, pair_features
from eddies.particles.flow_units import FlowUnits, allowed_step
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.model import LagrangianModel
from eddies.particles.moment import Moment, between
from eddies.particles.particle_set import ParticleSet
from eddies.scene.scene import Scene
from eddies.scene.terms import Forcing
from eddies.workflows.ground_truth.truth import GroundTruth, particles_for
from eddies.workflows.learned.model import load_feature_range, load_model
from eddies.workflows.rollout.particle_state import particle_state, restored_particles

log = logging.getLogger("eddies")

# A state is runaway, not turbulence, when a particle is this many times faster, or its density this many times
# farther from the mean, than the rms of the truth.
RUNAWAY_SPEED, RUNAWAY_DENSITY = 30.0, 300.0
# What is stored of the solves for the resolved velocity.
SOLVES = "solves", "iterations", "most_iterations", "residual", "not_converged"


class ParticleRun:
    """The particles of a frame of the ground truth, moved by a model.

    Its units are the scales of the flow at the release of the tracers, as in training. A subclass says which model it
    is (`build`), and how far a particle's density may deviate from the mean in a sound state (`largest_deviation`).
    """

    largest_deviation = np.inf
    seen: FeatureRange | None = None
    #: whether steps are limited to what the resolved velocity can follow; not where the step was found by rollouts
    limited = True

    def __init__(self, scene: Scene, truth: GroundTruth, start: int, directory: Path, device: torch.device) -> None:
        self.settings, self.comm, self.scales = scene.simulation, truth.decomposition.comm, truth.scales
        self.flow = FlowUnits(self.scales, scene.interaction_radius, scene.neighbors, scene.seed)
        dtype = getattr(torch, self.settings.precision)
        self.model = self.build(scene, directory).forced(injection(scene, truth)).to(dtype=dtype, device=device)
        self.dynamics = ParticleDynamics(truth.decomposition, self.model, self.settings.skin * self.flow.cutoff, dtype)
        self.integrator = INTEGRATORS[self.settings.scheme.name](self.dynamics)
        self.particles, self.total = particles_for(self.model, truth.particles(start), device), truth.total
        self._before: Moment | None = None
        self.limits = Limits(RUNAWAY_SPEED * self.scales.velocity, self.scales.density_mean, self.largest_deviation)
        self._shares_outside: list[float] = []
        self._solves: dict[str, list[float]] = {name: [] for name in SOLVES}

    def build(self, scene: Scene, directory: Path) -> LagrangianModel:
        """The model, without forcing; collective."""
        raise NotImplementedError

    @property
    def has_density(self) -> bool:
        """Whether the particles of its frames have a density."""
        return self.model.reads_density

    @property
    def time(self) -> float:
        """Time of the particles since the start."""
        return self.dynamics.time

    def advance(self, until: float, number: int) -> str | None:
        """Take a step towards a time; what is wrong with the state after it, on all ranks, or None.

        Steps are as long as the scene has them, or as the flow allows where that is less. Those of a scheme that can
        tell what was between them may go beyond that time; those of others end there.
        """
        step, left = min(self.settings.longest_step, self._allowed_step()), until - self.time
        if not self.integrator.scheme.dense:
            step = left / np.ceil(left / step - 1e-9)
        try:
            self._before = self._now() if step > left * (1 + 1e-9) else None
            self.particles = self.integrator.step(self.particles, step)
            fault = find_fault(self.particles, self.limits, self.dynamics.box, number, self.comm.rank)
            complaint = first_complaint(self.comm, fault)
            if complaint is None and self.integrator.scheme.dense:
                complaint = self._complaint_of_rates(number)
        except HaloError as error:  # on all ranks alike: particles outrun the halo
            return f"step {number}: {error}"
        return complaint

    def _allowed_step(self) -> float:
        """The longest step in which the resolved velocity, if there is one, can follow the flow as it is now."""
        resolution = self.dynamics.resolution
        if resolution is None or not self.limited:
            return np.inf
        highest = resolution.grid.resolved * 2 * np.pi / self.dynamics.box.length
        return allowed_step(self.integrator.scheme.angle, highest, resolution.speed)

    def _complaint_of_rates(self, number: int) -> str | None:
        """What is wrong with the rates at the end of a step, which a frame asks for and the next step begins with."""
        self.particles, rates = self.integrator.rates(self.particles)
        wrong = self.particles.id[~torch.isfinite(rates.acceleration).all(1)].tolist()
        return first_complaint(self.comm, f"step {number}, rank {self.comm.rank}, particle {wrong[0]}: its "
                                          "acceleration is not finite" if wrong else None)

    def frame(self, time: float) -> tuple[ParticleSet, torch.Tensor]:
        """The particles at a time that the last step reached, with the density that terms give if they do, and their
        acceleration."""
        if self._before is None:
            self.particles, rates = self.integrator.rates(self.particles)
            particles = self.particles
        else:
            found = between(self._before, self._now(), time, self.dynamics.box)
            particles, _ = self.dynamics.settle(particles_for(self.model, found.to_numpy(), self.particles.id.device))
            rates = self.dynamics.rates(particles, time=time)
        if rates.density is not None:
            particles = replace(particles, density=rates.density)
        if self.seen is not None:
            self._shares_outside.append(self.seen.share_outside(self.comm, pair_features(self.dynamics, particles)))
        self._count_solves()
        return particles, rates.acceleration

    def _now(self) -> Moment:
        """The particles with their acceleration, which the next step does not evaluate again; collective."""
        self.particles, rates = self.integrator.rates(self.particles)
        return Moment.of(self.comm, self.total, self.time, self.particles, rates)

    def _count_solves(self) -> None:
        """Take down what the closure's solves took since the last frame."""
        if self.dynamics.resolution is None:
            return
        solves, self.dynamics.resolution.solves = self.dynamics.resolution.solves, []
        iterations, residuals, converged = (np.array(column) for column in zip(*solves or [(0, 0.0, True)]))
        failed = int((~converged).sum())
        found = len(solves), iterations.sum(), iterations.max(), residuals.max(), failed
        for name, value in zip(SOLVES, found):
            self._solves[name].append(float(value))
        # Said once; the report counts them.
        if 0 < failed == sum(self._solves["not_converged"]) and self.comm.rank == 0:
            log.warning("rollout: %d of %d solves for the resolved velocity did not converge in %d iterations, the "
                        "worst left a residual of %.1e; the report counts later ones too", failed, len(solves),
                        max(iterations), residuals.max())

    def status(self) -> str:
        """Iterations of a solve for the resolved velocity, for the progress line: the last mean between two frames."""
        means = [iterations / count for count, iterations in zip(self._solves["solves"], self._solves["iterations"])
                 if count]
        return f"  iterations {means[-1]:.1f}" if means else ""

    def series(self) -> dict[str, dict[str, list[float]]]:
        """`outside_training`: the share of pairs that give the networks inputs outside the range of their training;
        `closure`: the solves for the resolved velocity since the frame before, all and most of their iterations, the
        largest residual, and how many did not converge."""
        found = {} if self.seen is None else {"outside_training": {"share": self._shares_outside}}
        return found if self.dynamics.resolution is None else {**found, "closure": self._solves}

    def state_dict(self) -> dict[str, Any]:
        """All that goes on, for a checkpoint between the frames of one step and the next step; collective."""
        return {**particle_state(self.particles, self.integrator), "series": {
            "outside_training": self._shares_outside, "closure": self._solves}}

    def load_state_dict(self, saved: Checkpoint) -> None:
        """Inverse of `state_dict`, bit for bit on the same number of ranks; collective."""
        self.particles = restored_particles(saved, self.integrator, self.particles.id.device)
        self._shares_outside, self._solves = (saved["series"][name] for name in ("outside_training", "closure"))

    def description(self) -> dict[str, float | str]:
        """Integrator, terms, whether they integrate a density, and how often rates were evaluated for the steps."""
        return {"integrator": self.settings.scheme.name, "terms": ", ".join(self.model.terms) or "none",
                "integrates_density": self.model.integrates_density, "evaluations": self.dynamics.evaluations}


class LearnedRun(ParticleRun):
    """Moved by the trained model of the run directory."""

    def build(self, scene: Scene, directory: Path) -> LagrangianModel:
        path = directory / "model.h5"
        model = load_model(scene, self.comm, path, self.scales)
        if model.integrates_density and self.scales.density is not None:
            self.largest_deviation = RUNAWAY_DENSITY * self.scales.density
        if model.networks:
            self.seen = load_feature_range(self.comm, path)
        return model


class BallisticRun(ParticleRun):
    """Not moved by anything: particles keep their velocity. Neither neighbour list nor messages."""

    def build(self, scene: Scene, directory: Path) -> LagrangianModel:
        return LagrangianModel({}, self.flow)


def injection(scene: Scene, truth: GroundTruth) -> Forcing | None:
    """The forcing of a rollout: that of the ground truth; or at a power per mass as given, or the dissipation rate of
    the ground truth, at the wavenumbers of [forcing]; or none."""
    power = scene.simulation.injection
    if power == "truth":
        return truth.forcing
    if power == "none":
        return None
    return Forcing(injection_rate=truth.reference["dissipation_rate"] if power == "dissipation" else power,
                   wavenumber=scene.forcing.wavenumber if scene.forcing else 2.0)
