"""The ground truths that a model is trained on: the run's own, or those that [training] truths names."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import torch

from eddies.errors import UserError
from eddies.io.hdf5 import File, open_product
from eddies.io.provenance import product_provenance
from eddies.io.trajectories import Trajectory
from eddies.parallel.communicator import Comm
from eddies.parallel.slab import SlabDecomposition
from eddies.pipeline import STAGES
from eddies.scene.rules import quoted
from eddies.scene.scene import BOX_LENGTH, Scene
from eddies.workflows.ground_truth.frame_counts import trained_frames
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.learned.training_data import TrainingData


@contextmanager
def open_truths(scene: Scene, comm: Comm, directory: Path) -> Iterator[tuple[GroundTruth, list[GroundTruth]]]:
    """The ground truth of a run directory, and those that its model is trained on; all ranks call it."""
    own_file = directory / STAGES["dns"].file
    with ExitStack() as files:
        def opened(path: Path) -> GroundTruth:
            return _truth_in(files.enter_context(open_product(comm, path, "ground_truth")), scene, comm)

        own = opened(own_file)
        named = scene.training.truth_files or (own_file,)
        yield own, [own if path.resolve() == own_file.resolve() else opened(path) for path in named]


def training_data(scene: Scene, truths: Sequence[GroundTruth], device: torch.device) -> list[TrainingData]:
    """What the model is trained on of each ground truth, the parameters shared by all; frames are evenly shared."""
    data: list[TrainingData] = []
    for number, truth in enumerate(truths):
        count = len(range(number, scene.training.frames, len(truths)))
        data.append(TrainingData(scene, truth, count, device, data[0].model if data else None))
    return data


def truth_ids(scene: Scene) -> dict[str, str | None]:
    """The ids of the ground truths that [training] names, by path."""
    return {str(path): product_provenance(path).get("id") for path in scene.training.truth_files}


def truth_problems(scene: Scene, comm: Comm, directory: Path) -> list[str]:
    """Why the model of a run directory cannot be trained on the ground truths that its scene names, in words; all ranks
    call it. Its own, which may not be there yet, is not looked at."""
    if scene.training is None or scene.training.truths is None or scene.model.path is not None:
        return []
    own, found, seen = (directory / STAGES["dns"].file).resolve(), [], set()
    for name, path in zip(scene.training.truths, scene.training.truth_files):
        place, file = f"[training] truths: {quoted(name)}", path.resolve()
        if file in seen:
            found.append(f"{place}: is named before; name each ground truth once")
        elif file != own:
            try:
                with open_product(comm, path, "ground_truth") as opened:
                    found += [f"{place}: {problem}" for problem in _problems_of(scene, comm, opened)]
            except UserError as error:
                found.append(f"{place}: {error}")
        seen.add(file)
    return found


def _truth_in(file: File, scene: Scene, comm: Comm) -> GroundTruth:
    """An open ground truth on slabs that fit its number of particles."""
    side = round(Trajectory(file, "tracers").total ** (1 / 3))
    planes = replace(scene.tracers, particles_per_side=side).planes
    return GroundTruth(file, SlabDecomposition(comm, BOX_LENGTH, planes))


def _problems_of(scene: Scene, comm: Comm, file: File) -> Iterator[str]:
    """What an open ground truth of another run has that does not fit a scene."""
    if "particles/tracers" not in file:
        yield "holds no tracers to learn from; give the run of a scene with [tracers]"
        return
    settings, tracers, truth = scene.training, scene.tracers, _truth_in(file, scene, comm)
    scales = truth.scales
    here, there = tracers.filter_width / tracers.spacing, scales.filter_width / scales.spacing
    if not math.isclose(here, there, rel_tol=1e-6):
        yield (f"its filter is {there:.9g} mean spacings wide, and [tracers] filter_width = "
               f"{tracers.filter_width:.9g} is {here:.9g}; give another run, or set filter_width = "
               f"{there * tracers.spacing:.9g}")
    if "density" in scene.model.reads and not truth.has_density:
        yield ("holds no density, which the terms of [model] read; give one of a compressible flow, or leave such "
               "terms out")
    if settings.batch > truth.total:
        yield f"holds {truth.total} particles, fewer than [training] batch = {settings.batch}; lower batch"
    if settings.field_weight > 0 and not math.isclose(tracers.spacing, scales.spacing, rel_tol=1e-6):
        yield (f"its particles have a mean spacing of {scales.spacing:.4g}, and [training] field_weight = "
               f"{settings.field_weight:g} averages with a kernel for {tracers.spacing:.4g}; remove field_weight, or "
               "give another run")
    interval = float(truth.times[1] - truth.times[0])
    if settings.horizons and not math.isclose(tracers.frame_interval, interval, rel_tol=1e-6):
        yield (f"its frames are {interval:.6g} apart, and [training.horizons] counts frames of [tracers] "
               f"frame_interval = {tracers.frame_interval:g}; make them equal, or leave the horizons out")
    trained_frames(settings, len(truth.times), truth.at_fields)
