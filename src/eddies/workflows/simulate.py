"""Rollout: the trained model as a particle simulation, from a moment of the ground truth on."""

from __future__ import annotations

import logging
import time
from pathlib import Path

import numpy as np
import torch

from eddies.clock import Clock, ProgressLine
from eddies.io.hdf5 import create_product, open_product, write_attributes
from eddies.io.weights import load_weights
from eddies.parallel.broadcast import first_complaint
from eddies.parallel.halo import HaloError
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.parallel.stop import StopRequest
from eddies.particles.body_forces import LinearForcing
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.faults import Limits, find_fault
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.pair_forces import PairModel
from eddies.particles.particle_set import ParticleSet
from eddies.scene import BOX_LENGTH, Scene, SceneError
from eddies.workflows.closures import load_kernel, poisson_closure
from eddies.workflows.devices import prepare_torch
from eddies.workflows.rollout_frames import RolloutFrames
from eddies.workflows.truth import GroundTruth

log = logging.getLogger("eddies")

# A state is runaway, not turbulence, when a particle is this many times faster, or its density this many times
# farther from the mean, than the rms of the truth.
RUNAWAY_SPEED, RUNAWAY_DENSITY = 30.0, 300.0
# Largest velocity component to be expected of a particle, over the rms: how far it may go within a step.
PEAK_SPEED = 6.0


def run(scene: Scene, comm, directory: str | Path, stop: StopRequest | None = None) -> None:
    """Simulate with the trained model and write rollout.h5. A run that goes wrong ends there, keeps its frames, and
    says so in its status."""
    device = prepare_torch(scene.device, comm)
    directory, settings = Path(directory), scene.simulation
    slab = SlabDecomposition(comm, BOX_LENGTH, scene.tracers.particles_per_side)
    provenance = {"scene": scene.to_toml(), "fingerprint": scene.fingerprint("simulate")}
    with (open_product(comm, directory / "ground_truth.h5", "ground_truth") as truth_file,
          create_product(comm, directory / "rollout.h5", "rollout", provenance) as file):
        truth = GroundTruth(truth_file, slab)
        model = load_model(comm, directory / "model.h5", device)
        dynamics = build_dynamics(scene, truth, model)
        start = start_frame(scene, truth)
        particles = ParticleSet.from_numpy(truth.particles(start), device)
        frames = RolloutFrames(file, truth, load_kernel(comm, directory / "kernel.h5"), truth.times[start])
        turnover = truth.reference["eddy_turnover_time"]
        count = int(np.ceil(settings.turnovers * turnover / settings.frame_interval - 1e-9))
        with torch.no_grad():
            outcome = roll_out(scene, dynamics, particles, frames, count, truth, stop or StopRequest(comm))
        write_attributes(file.create_group("rollout"), {
            **outcome, "turnovers": outcome["time"] / turnover, "eddy_turnover_time": turnover,
            "start_time": float(truth.times[start]), "integrator": settings.integrator, "closure": model.closure,
            "particles": truth.total, "ranks": comm.size})
    log.info("rollout: %s after %.2f turnovers, %.3f s/step", outcome["status"], outcome["time"] / turnover,
             outcome["seconds_per_step"])


def roll_out(scene: Scene, dynamics: ParticleDynamics, particles: ParticleSet, frames: RolloutFrames, count: int,
             truth: GroundTruth, stop: StopRequest) -> dict[str, float | str]:
    """Advance `count` frame intervals, or until the state is at fault; returns status, time and seconds a step."""
    settings, scales, comm = scene.simulation, truth.scales, truth.decomposition.comm
    substeps = max(int(np.ceil(settings.frame_interval / settings.step - 1e-9)), 1)
    step = settings.frame_interval / substeps
    integrator = INTEGRATORS[settings.integrator](dynamics)
    limits = Limits(RUNAWAY_SPEED * scales.velocity, scales.density_mean, RUNAWAY_DENSITY * scales.density)
    clock, seconds, complaint = Clock(end=count * settings.frame_interval), [], None
    progress = ProgressLine("rollout", lambda: f"t {clock.time:.3f}  energy {energy:.4f}")
    energy = mean_energy(comm, particles, truth.total)
    store(frames, dynamics, particles, clock)
    while clock.running and complaint is None:
        for _ in range(substeps):
            stop.check()
            began = time.perf_counter()
            try:
                particles = integrator.step(particles, step)
            except HaloError as error:  # on all ranks alike: particles outrun the halo
                complaint = f"step {clock.steps + 1}: {error}"
                break
            clock.tick(step)
            complaint = first_complaint(comm, find_fault(particles, limits, dynamics.box, clock.steps, comm.rank))
            seconds.append(time.perf_counter() - began)
            if complaint is not None:
                break
        else:
            energy = mean_energy(comm, particles, truth.total)
            store(frames, dynamics, particles, clock)
            progress(clock.time / clock.end, clock.steps)
    if complaint is not None and comm.rank == 0:
        log.warning("rollout stopped at time %.4g: %s", clock.time, complaint)
    return {"status": "complete" if complaint is None else f"stopped: {complaint}", "time": clock.time,
            "time_step": step, "seconds_per_step": float(np.median(seconds or [np.nan]))}


def store(frames: RolloutFrames, dynamics: ParticleDynamics, particles: ParticleSet, clock: Clock) -> None:
    """Store a frame with the acceleration that the model gives its state."""
    particles, _ = dynamics.settle(particles)
    frames.store(clock.steps, clock.time, particles, dynamics.rates(particles)["velocity"])


def mean_energy(comm, particles: ParticleSet, total: int) -> float:
    """Kinetic energy per particle <v.v>/2 over all ranks."""
    return float(global_sum(comm, 0.5 * float(particles.velocity.double().square().sum()))) / total


def start_frame(scene: Scene, truth: GroundTruth) -> int:
    """The first frame with a filtered field at or after the moment that the scene asks for.

    Raises SceneError if none follows that leaves a frame of the ground truth to compare with.
    """
    fraction = scene.simulation.start
    last_seen = truth.last_frame_seen(scene.training.window)
    wanted = last_seen if fraction is None else int(fraction * (len(truth.times) - 1))
    at_fields = [truth.frame_of_field(index) for index in range(len(truth.fields.times))]
    last = len(truth.times) - 2 - round(scene.simulation.frame_interval / scene.tracers.frame_interval)
    usable = [frame for frame in at_fields if max(wanted, 1) <= frame <= last]
    if not usable:
        raise SceneError(f"[simulation] start: after frame {wanted} of {len(truth.times)} no filtered field is "
                         "followed by ground truth to compare with; lower start or [training] window, or raise "
                         "[tracers] turnovers")
    return usable[0]


def build_dynamics(scene: Scene, truth: GroundTruth, model: PairModel) -> ParticleDynamics:
    """The model, the forcing if there is one, and the closure if the density has no rate of its own."""
    settings, slab = scene.simulation, truth.decomposition
    skin = settings.skin * model.cutoff
    dtype = getattr(torch, settings.precision)
    terms = [model.to(dtype)]
    if settings.injection != "none":
        rate = truth.reference["dissipation_rate"] if settings.injection == "dissipation" else settings.injection
        terms.append(LinearForcing(rate, scene.forcing.wavenumber if scene.forcing else 2.0, slab.comm, slab.length))
    closure = None
    if model.closure == "poisson":
        drift = PEAK_SPEED * truth.scales.velocity * settings.step
        closure = poisson_closure(slab, truth.scales.sound_speed, dtype, skin, drift)
    return ParticleDynamics(slab, slab.length, terms, skin, closure, dtype)


def load_model(comm, path: str | Path, device: torch.device) -> PairModel:
    """The trained model of a file."""
    description, tensors = load_weights(comm, path, "model")
    model = PairModel.from_description(description)
    model.load_state_dict({name: torch.from_numpy(tensor) for name, tensor in tensors.items()})
    return model.to(device)
