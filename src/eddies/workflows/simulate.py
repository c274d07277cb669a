"""Rollout: particles start at a frame of the ground truth, and the trained model or a baseline moves them."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import torch

from eddies.clock import pace_in_words
from eddies.io.frame_segments import FrameSegments
from eddies.io.checkpoint import Guard
from eddies.io.hdf5 import Table, create_product, write_table
from eddies.io.new_files import set_attributes
from eddies.parallel.communicator import Comm
from eddies.parallel.stop import StopRequest
from eddies.particles.devices import prepare_torch
from eddies.pipeline import STAGES
from eddies.scene.scene import Scene
from eddies.workflows import measure
from eddies.workflows.ground_truth.frame_counts import rollout_start
from eddies.workflows.ground_truth.truth import open_truth
from eddies.workflows.rollout.course import Course, frame_layout
from eddies.workflows.rollout.method import TimeStep, forcing_of, make_method
from eddies.workflows.run_directory.fingerprints import stage_provenance
from eddies.workflows.run_directory.work import read_found_step, step_path

log = logging.getLogger("eddies")


def run(scene: Scene, comm: Comm, directory: str | Path, stop: StopRequest | None = None) -> None:
    """Run the rollout of a scene, write rollout.h5, and measure the rollout.

    If the state becomes faulty, the rollout ends. The product then holds the frames so far, and its status describes
    the fault. A stopped rollout continues from its newest checkpoint.
    """
    directory, settings, device = Path(directory), scene.simulation, prepare_torch(scene.device, comm)
    provenance = stage_provenance(scene, "simulate")
    guard = Guard(comm, directory / STAGES["simulate"].checkpoints, provenance["fingerprint"], stop,
                  " of the rollout")
    with open_truth(comm, directory / STAGES["dns"].file, device) as truth, torch.no_grad():
        start = rollout_start(settings, scene.tracers, scene.seen_in(directory), len(truth.times), truth.field_frames)
        step = None
        if (path := step_path(settings, directory)) is not None:
            found, _ = read_found_step(path, comm)
            step = TimeStep(found["integrator"], found["size"])
        method = make_method(scene, step, truth, start, directory)
        saved = guard.checkpoints.newest()
        layout = frame_layout(truth.total, truth.decomposition.length, method.has_density)
        segments = FrameSegments(comm, guard.checkpoints.path, layout, () if saved is None else saved.files)
        turnover = truth.reference["eddy_turnover_time"]
        count = int(np.ceil(settings.turnovers * turnover / settings.frame_interval - 1e-9))
        forcing = forcing_of(settings.injection, scene.forcing, truth)
        with segments:
            course = Course(method, segments, count, settings.frame_interval, guard, saved)
            outcome = course.run()
            with create_product(comm, directory / STAGES["simulate"].file, "rollout", provenance) as file:
                segments.assemble(file)
                set_attributes(file.create_group("rollout"), {
                    **outcome, **method.description(), "method": settings.method,
                    "turnovers": outcome["time"] / turnover,
                    "injection_rate": forcing.injection_rate if forcing else 0.0,
                    "truth_injection_rate": truth.forcing.injection_rate if truth.forcing else 0.0,
                    "eddy_turnover_time": turnover, "start_time": float(truth.times[start]),
                    "particles": truth.total, "ranks": comm.size})
                for name, columns in method.series().items():
                    write_table(file, name, Table({"time": course.times, **columns}, "time", {"time": "T"}))
    guard.checkpoints.remove()
    measure.run(directory, comm)
    pace = (pace_in_words(outcome["seconds_per_step"], outcome["storing_share"]) if "seconds_per_step" in outcome
            else "too few steps to time")
    log.info("rollout: %.2f turnovers, %s; %s", outcome["time"] / turnover, pace, outcome["status"])
