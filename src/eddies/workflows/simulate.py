"""Rollout: particles from a moment of the ground truth on, moved by the trained model or by a baseline."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import torch

from eddies.clock import pace_in_words
from eddies.io.frame_segments import FrameSegments
from eddies.io.checkpoint import Guard
from eddies.io.hdf5 import create_product, open_product, write_attributes, write_table
from eddies.parallel.communicator import Comm
from eddies.parallel.slab import SlabDecomposition
from eddies.parallel.stop import StopRequest
from eddies.particles.devices import prepare_torch
from eddies.pipeline import STAGES
from eddies.scene.scene import BOX_LENGTH, Scene
from eddies.scene.terms import Forcing
from eddies.workflows.ground_truth.frame_counts import rollout_start
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.rollout.course import Course, frame_layout
from eddies.workflows.rollout.method_of_step import method_of_step, stored_step
from eddies.workflows.rollout.particle_run import injection
from eddies.workflows.run_directory.fingerprints import stage_fingerprint, stage_provenance

log = logging.getLogger("eddies")


def run(scene: Scene, comm: Comm, directory: str | Path, stop: StopRequest | None = None) -> None:
    """Simulate what a scene asks for and write rollout.h5. A run that goes wrong ends there, keeps its frames, and
    says so in its status; one that is stopped goes on from a checkpoint."""
    device = prepare_torch(scene.device, comm)
    directory, settings = Path(directory), scene.simulation
    slab = SlabDecomposition(comm, BOX_LENGTH, scene.tracers.planes)
    guard = Guard(comm, directory / STAGES["simulate"].checkpoints, stage_fingerprint(scene, "simulate"), stop,
                  " of the rollout")
    with open_product(comm, directory / "ground_truth.h5", "ground_truth") as truth_file, torch.no_grad():
        truth = GroundTruth(truth_file, slab)
        start, found = start_frame(scene, truth, directory), stored_step(scene, comm, directory)
        method = method_of_step(scene, found, truth, start, directory, device)
        saved = guard.checkpoints.newest()
        layout = frame_layout(truth.total, slab.length, method.has_density)
        segments = FrameSegments(comm, guard.checkpoints.path, layout, () if saved is None else saved.files)
        turnover = truth.reference["eddy_turnover_time"]
        count = int(np.ceil(settings.turnovers * turnover / settings.frame_interval - 1e-9))
        with segments:
            course = Course(method, segments, count, settings.frame_interval, guard, saved)
            outcome = course.run()
            with create_product(comm, directory / "rollout.h5", "rollout", stage_provenance(scene, "simulate")) as file:
                segments.assemble(file)
                write_attributes(file.create_group("rollout"), {
                    **outcome, **method.description(), "method": settings.method,
                    "turnovers": outcome["time"] / turnover, "injection_rate": forcing_rate(injection(scene, truth)),
                    "truth_injection_rate": forcing_rate(truth.forcing),
                    "eddy_turnover_time": turnover, "start_time": float(truth.times[start]),
                    "particles": truth.total, "ranks": comm.size})
                for name, columns in method.series().items():
                    write_table(file, name, {"time": course.times, **columns})
    guard.checkpoints.remove()
    pace = (pace_in_words(outcome["seconds_per_step"], outcome["storing_share"]) if "seconds_per_step" in outcome
            else "too few steps to time one")
    log.info("rollout: %s after %.2f turnovers, %s", outcome["status"], outcome["time"] / turnover, pace)


def forcing_rate(forcing: Forcing | None) -> float:
    """Power per mass of a forcing, 0 without one."""
    return 0.0 if forcing is None else forcing.injection_rate


def start_frame(scene: Scene, truth: GroundTruth, directory: Path) -> int:
    """The frame from which the rollout of a run directory starts: see `rollout_start`."""
    at_fields = [truth.frame_of_field(index) for index in range(len(truth.fields.times))]
    return rollout_start(scene, scene.seen_in(directory), len(truth.times), at_fields)
