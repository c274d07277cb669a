"""The methods that move the particles of a rollout: their interface, particles that a model or no force moves, and the
choice of the method of a scene."""

import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from eddies.clock import rounded_up
from eddies.import_path import is_path, load, users_code
from eddies.io.checkpoint import Checkpoint
from eddies.io.weights import load_weights
from eddies.parallel.broadcast import first_complaint
from eddies.parallel.halo import HaloError
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.exchanges import fluctuations, mean_over_ranks, root_mean_square
from eddies.particles.faults import Limits, find_fault
from eddies.particles.feature_range import FeatureRange, pair_features
from eddies.particles.flow_units import FlowUnits, allowed_step
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.model import LagrangianModel
from eddies.particles.moment import Moment, between
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.pipeline import STAGES
from eddies.scene.integrators import Scheme
from eddies.scene.scene import Eulerian, Scene, SceneError, Simulation
from eddies.scene.scene import Forcing as ForcingSection
from eddies.scene.terms import Forcing, StepUnits, TermSettings
from eddies.workflows.ground_truth.flow_run import restored_modes, restored_rows, saved_modes, saved_rows
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.learned.model import particles_for, trained_model
from eddies.workflows.learned.source import ModelDefinition
from eddies.workflows.rollout.eulerian_run import EulerianRun, coarse_fluid

log = logging.getLogger("eddies")

# A state is faulty if the speed of a particle, relative to the mean velocity at the start, exceeds RUNAWAY_SPEED times
# the rms velocity of the truth. It is also faulty if the density of a particle deviates from the mean density by more
# than this mean and by more than RUNAWAY_DENSITY times the true rms deviation.
RUNAWAY_SPEED, RUNAWAY_DENSITY = 30.0, 300.0
# Columns of the table on the solves for the resolved velocity; see `ParticleRun.series`.
SOLVES = "solves", "iterations", "most_iterations", "residual", "not_converged"
# Names of columns in checkpoints: prefix of the rates that an integrator keeps, and positions of the neighbour list.
MEMORY, BUILT_AT = "memory ", "built at"


class Method(Protocol):
    """Moves the particles of a rollout. All functions are collective.

    A user's class is called with (scene, truth, start, directory, device), where `start` is the frame of the ground
    truth at which the rollout starts. It may lack `state_dict` and `load_state_dict`. A stopped rollout then starts
    again from the beginning.
    """

    has_density: bool  # whether the particles of a frame have a density

    time: float  # time of the particles since the start of the rollout

    def advance(self, until: float, number: int) -> str | None:
        """Take the step with this `number` towards the time `until`.

        The step may pass that time if `frame` can interpolate. Returns a text that describes the fault of the new
        state, or None if there is no fault; the result is the same on all ranks.
        """

    def frame(self, time: float) -> tuple[ParticleSet, torch.Tensor]:
        """Return the particles at a time within the last step, in any order, and their acceleration (n, 3)."""

    def status(self) -> str:
        """Return the text that the progress line shows after the time and the energy."""

    def series(self) -> dict[str, dict[str, list[float]]]:
        """Return tables for the product: values by name of the table and of the column. Each column has one value for
        each call of `frame`."""

    def description(self) -> dict[str, float | str]:
        """Return the settings of the method, which become attributes of the product."""

    def state_dict(self) -> dict[str, Any]:
        """Return the present state by name, as `CheckpointDirectory.write` takes it. No name begins with "rollout"."""

    def load_state_dict(self, saved: Checkpoint) -> None:
        """Continue from a checkpoint that was made on any number of ranks. The continued run is exact on the same
        number."""


@dataclass(frozen=True)
class TimeStep:
    """Integrator and longest time step of a rollout. On a coarse grid they are "etdrk4" and the Courant number."""

    integrator: str
    size: float


class ParticleRun:
    """Particles that start at a frame of the ground truth and are moved by a model. The model may have no terms.

    Particles without forces have no neighbour list and send no message.

    Parameters
    ----------
    model : the model in the units of the flow at the release of the tracers, as in training.
    seen : the range of network inputs in the training, None without networks.
    start : number of the frame.
    limited : whether the resolved velocity limits the step; false if the step was found by rollouts.
    """

    def __init__(self, model: LagrangianModel, seen: FeatureRange | None, settings: Simulation, truth: GroundTruth,
                 start: int, limited: bool) -> None:
        self.settings, self.comm, self.seen, self.limited = settings, truth.decomposition.comm, seen, limited
        scales, dtype, deviation = truth.scales, getattr(torch, settings.precision), np.inf
        self.model = model.to(dtype=dtype, device=truth.device)
        self.dynamics = ParticleDynamics(truth.decomposition, model, settings.skin * model.flow.cutoff, dtype)
        self.integrator = INTEGRATORS[settings.scheme.name](self.dynamics)
        self.particles, self.total = particles_for(model, truth.particles(start), truth.device), truth.total
        self._before: Moment | None = None
        if model.integrates_density and scales.density is not None:
            deviation = max(RUNAWAY_DENSITY * scales.density, scales.density_mean)
        frame = mean_over_ranks(self.comm, self.particles.velocity)
        self.limits = Limits(RUNAWAY_SPEED * scales.velocity, frame, scales.density_mean, deviation)
        self._limiting = [term.settings for term in self.model.terms.values() if term.settings.follows_flow]
        self._shares_outside: list[float] = []
        self._solves: dict[str, list[float]] = {name: [] for name in SOLVES}

    @property
    def has_density(self) -> bool:
        """Whether the particles of a frame have a density."""
        return self.model.reads_density

    @property
    def time(self) -> float:
        """Time of the particles since the start."""
        return self.dynamics.time

    def advance(self, until: float, number: int) -> str | None:
        """Take the step with this `number` towards the time `until`.

        The step is as long as the scene allows, or shorter if the flow demands it. A scheme with dense output may step
        beyond `until`. Other schemes divide the time left to `until` into equal steps. Returns a text that describes
        the fault of the new state, or None if there is no fault; the result is the same on all ranks.
        """
        step, left = min(self.settings.longest_step, self._allowed_step()), until - self.time
        if not self.integrator.scheme.dense:
            step = left / rounded_up(left / step)
        try:
            self._before = self._now() if step > left * (1 + 1e-9) else None
            self.particles = self.integrator.step(self.particles, step)
            fault = find_fault(self.particles, self.limits, self.dynamics.box, number, self.comm.rank)
            complaint = first_complaint(self.comm, fault)
            if complaint is None and self.integrator.scheme.dense:
                complaint = self._complaint_of_rates(number)
        except HaloError as error:  # raised on all ranks: particles are faster than the halo allows
            return f"step {number}: {error}"
        return complaint

    def _allowed_step(self) -> float:
        """Return the longest step that the terms and the resolved velocity allow in the present flow, or infinity if
        they set no limit."""
        resolution, scheme = self.dynamics.resolution, self.integrator.scheme
        allowed = math.inf
        if self._limiting:
            speed = root_mean_square(self.comm, fluctuations(self.comm, self.particles.velocity))
            allowed = allowed_by_terms(self._limiting, self.model.flow, scheme, speed)
        if resolution is None or not self.limited:
            return allowed
        return min(allowed, allowed_step(scheme.angle, resolution.grid.highest, resolution.speed))

    def _complaint_of_rates(self, number: int) -> str | None:
        """Return a complaint if a rate at the end of step `number` is not finite. The next frame and the next step use
        these rates."""
        self.particles, rates = self.integrator.rates(self.particles)
        wrong = self.particles.id[~torch.isfinite(rates.acceleration).all(1)].tolist()
        return first_complaint(self.comm, f"step {number}, rank {self.comm.rank}, particle {wrong[0]}: its "
                                          "acceleration is not finite" if wrong else None)

    def frame(self, time: float) -> tuple[ParticleSet, torch.Tensor]:
        """Return the particles at a time within the last step, and their acceleration. They have the density that terms
        give."""
        if self._before is None:
            self.particles, rates = self.integrator.rates(self.particles)
            particles = self.particles
        else:
            columns = between(self._before, self._now(), time, self.dynamics.box).to_numpy()
            [particles] = self.dynamics.settle(particles_for(self.model, columns, self.particles.id.device))
            rates = self.dynamics.rates(particles, time=time)
        if rates.density is not None:
            particles = replace(particles, density=rates.density)
        if self.seen is not None:
            self._shares_outside.append(self.seen.share_outside(self.comm, pair_features(self.dynamics, particles)))
        self._count_solves()
        return particles, rates.acceleration

    def _now(self) -> Moment:
        """Return the present particles and their rates. The next step reuses these rates. Collective."""
        self.particles, rates = self.integrator.rates(self.particles)
        return Moment.of(self.comm, self.total, self.time, self.particles, rates)

    def _count_solves(self) -> None:
        """Add a row to the table with the columns SOLVES, for the solves for the resolved velocity since the last
        frame."""
        if self.dynamics.resolution is None:
            return
        solves, self.dynamics.resolution.solves = self.dynamics.resolution.solves, []
        iterations, residuals, converged = (np.array(column) for column in zip(*solves or [(0, 0.0, True)]))
        failed = int((~converged).sum())
        for name, value in zip(SOLVES, (len(solves), iterations.sum(), iterations.max(), residuals.max(), failed)):
            self._solves[name].append(float(value))
        # Logged once; the report gives the number.
        if 0 < failed == sum(self._solves["not_converged"]) and self.comm.rank == 0:
            log.warning("rollout: %d of %d solves for the resolved velocity did not converge in %d iterations; the "
                        "largest residual is %.1e. Later ones are not logged; the report counts all", failed,
                        len(solves), max(iterations), residuals.max())

    def status(self) -> str:
        """Return a text for the progress line: the mean number of iterations of a solve for the resolved velocity
        between the last two frames."""
        means = [iterations / count for count, iterations in zip(self._solves["solves"], self._solves["iterations"])
                 if count]
        return f"  iterations {means[-1]:.1f}" if means else ""

    def series(self) -> dict[str, dict[str, list[float]]]:
        """Return the tables, with a row for each frame.

        `outside_training`: `share` of the pairs whose network inputs are outside the range of the training. `closure`:
        columns SOLVES on the solves for the resolved velocity since the last frame. They are the number of solves, the
        sum of their iterations, the most iterations of one solve, the largest residual, and the number of solves that
        did not converge.
        """
        tables = {} if self.seen is None else {"outside_training": {"share": self._shares_outside}}
        return tables if self.dynamics.resolution is None else {**tables, "closure": self._solves}

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a checkpoint; collective. Call it after the frames of a step, before the next step.

        It has the particles that the integrator returned last, the rates that the integrator keeps, the positions at
        which the neighbour list was built, start values for the next solves, and the tables.
        """
        dynamics, resolution = self.dynamics, self.dynamics.resolution
        columns = self.particles.to_numpy() | {
            MEMORY + name: as_numpy(rate) for name, rate in self.integrator.memory.items()}
        built_at = dynamics.built_at(self.particles)
        if built_at is not None:
            columns[BUILT_AT] = as_numpy(built_at)
        state = {"time": dynamics.time, "evaluations": dynamics.evaluations, **saved_rows(self.comm, columns),
                 "series": {"outside_training": self._shares_outside, "closure": self._solves}}
        if resolution is not None:
            values = resolution.state_dict()
            solves = [(int(iterations), float(residual), bool(converged))
                      for iterations, residual, converged in resolution.solves]
            state |= {"closure": {"times": values["times"].tolist(), "means": values["means"].tolist(),
                                  "speed": float(values["speed"]), "solves": solves},
                      "modes": saved_modes(resolution.grid.spectral, as_numpy(values["modes"]))}
        return state

    def load_state_dict(self, saved: Checkpoint) -> None:
        """Restore a state of `state_dict`; collective.

        The continued run is exact on the same number of ranks. On another number the particles move to their slabs, and
        the neighbour list is built again.
        """
        dynamics, resolution, device = self.dynamics, self.dynamics.resolution, self.particles.id.device
        state = {"time": torch.tensor(saved["time"], dtype=torch.float64)}
        if resolution is not None:
            closure = saved["closure"]
            state |= {"modes": torch.from_numpy(restored_modes(resolution.grid.spectral, saved, 6)),
                      "times": torch.tensor(closure["times"], dtype=torch.float64),
                      "means": torch.tensor(closure["means"], dtype=torch.float64).reshape(-1, 3),
                      "speed": torch.tensor(closure["speed"], dtype=torch.float64)}
            resolution.solves = [tuple(solve) for solve in closure["solves"]]
        dynamics.load_state_dict(state)
        dynamics.evaluations = saved["evaluations"]
        columns, same = restored_rows(dynamics.decomposition, saved)
        self.particles = ParticleSet.from_numpy(columns, device)
        if same and BUILT_AT in columns:
            dynamics.rebuild(self.particles, torch.from_numpy(columns[BUILT_AT]).to(device))
        memory = {name.removeprefix(MEMORY): torch.from_numpy(column).to(device) for name, column in columns.items()
                  if name.startswith(MEMORY)}
        self.integrator.restore(self.particles if memory else None, memory)
        self._shares_outside, self._solves = (saved["series"][name] for name in ("outside_training", "closure"))

    def description(self) -> dict[str, float | str]:
        """Return attributes of the product: integrator, terms, whether the terms integrate a density, and number of
        evaluations of the rates."""
        return {"integrator": self.settings.scheme.name, "terms": ", ".join(self.model.terms) or "none",
                "integrates_density": self.model.integrates_density, "evaluations": self.dynamics.evaluations}


def allowed_by_terms(terms: Iterable[TermSettings], flow: FlowUnits, scheme: Scheme, speed: float) -> float:
    """Return the longest step that terms allow in a flow with this rms of a velocity component; infinite without a
    limit."""
    units = StepUnits(radius=flow.cutoff, filter_width=flow.scales.filter_width, sound_speed=flow.scales.sound_speed,
                      velocity=speed, scheme=scheme)
    return min((term.longest_step(units) for term in terms), default=math.inf)


def make_method(scene: Scene, step: TimeStep | None, truth: GroundTruth, start: int, directory: Path) -> Method:
    """Make the method of a scene for a rollout that starts at the frame `start` of the truth; collective.

    A given `step` replaces the step of the scene; the resolved velocity then does not limit the step. `directory` is
    the run directory.
    """
    settings, courant = scene.simulation, scene.time.courant
    if step is not None and settings.form.on_grid:
        courant = step.size
    elif step is not None:
        settings = replace(settings, integrator=step.integrator, step=step.size, step_from=None, confirmed_on=None)
    if is_path(settings.method):
        kind = load(settings.method)
        hint = f'; [simulation] method = "{settings.method}" is called with (scene, truth, start, directory, device)'
        with users_code(kind, SceneError, hint):
            return kind(replace(scene, simulation=settings), truth, start, directory, truth.device)
    comm, trained = truth.decomposition.comm, directory / STAGES["train"].file
    forcing = forcing_of(settings.injection, scene.forcing, truth)
    if settings.form.on_grid:
        eulerian, rates = scene.eulerian or Eulerian(), None
        if eulerian.form.learned:
            rates = load_weights(comm, trained, "model").weights[f"terms.{scene.model.damping}"]
        fluid = coarse_fluid(eulerian, scene.flow, settings.precision, forcing, truth, rates)
        return EulerianRun(eulerian, fluid, truth, start, settings.longest_step, courant, scene.tracers.interpolation)
    definition, seen = ModelDefinition.of(scene), None
    model = LagrangianModel({}, definition.units(truth.scales))
    if "model" in settings.form.needs:
        stored = load_weights(comm, trained, "model")
        model = trained_model(definition, stored, truth.scales, comm)
        seen = FeatureRange(**stored.tables["feature_range"]) if model.networks else None
    return ParticleRun(model.forced(forcing), seen, settings, truth, start, limited=step is None)


def forcing_of(power: str | float, section: ForcingSection | None, truth: GroundTruth) -> Forcing | None:
    """Return the forcing of a rollout, or None if the rollout is not forced.

    `power` is the key `injection` of [simulation]: "truth" for the forcing of the ground truth, "none" for no forcing,
    or a number, the power per mass. "dissipation" means the dissipation rate of the ground truth. Modes with
    |k| < k_f are forced, where k_f is the `wavenumber` of `section`, [forcing] of the scene, or 2 without it.
    """
    if power == "truth":
        return truth.forcing
    if power == "none":
        return None
    return Forcing(injection_rate=truth.reference["dissipation_rate"] if power == "dissipation" else power,
                   wavenumber=section.wavenumber if section else 2.0)
