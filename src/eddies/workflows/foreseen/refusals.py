"""What keeps a stage from its end, as far as files that the scene names and this machine tell it before."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

from eddies.errors import UserError
from eddies.io.single_writer import LARGEST_BYTES, REMEDY, has_single_writer
from eddies.parallel.broadcast import on_first_rank
from eddies.parallel.communicator import Comm, node_ranks
from eddies.pipeline import STAGES
from eddies.scene.scene import Scene
from eddies.workflows.foreseen.stage_cost import StageCost, in_units
from eddies.workflows.foreseen.stage_costs import totals
from eddies.workflows.foreseen.stored import product_bytes
from eddies.workflows.ground_truth.scene_flow import stored_states


def refusals(scene: Scene, comm: Comm, costs: Sequence[StageCost]) -> list[str]:
    """A line for each; all ranks call it and get the same."""
    found = [*start_file(scene, comm), *forced_modes(scene), *weights(scene, comm), *truths(scene, comm)]
    return found + [*single_writer(scene.stages, scene, comm), *memory(comm, costs), *disk(comm, costs)]


def start_file(scene: Scene, comm: Comm) -> Iterator[str]:
    """A file to start from that is not there, or without a state to start from."""
    if not scene.initial.flow.from_file:
        return
    try:
        with stored_states(scene.initial, comm):
            pass
    except UserError as error:
        yield str(error)


def forced_modes(scene: Scene) -> Iterator[str]:
    """A start without energy at the modes that linear forcing amplifies."""
    initial, forcing = scene.initial, scene.forcing
    if forcing is None or forcing.injection_rate == 0:
        return
    wave = initial.flow.wave and initial.flow.wave * initial.wavenumber
    if initial.flow.sound or wave and wave >= forcing.wavenumber:
        yield (f'[forcing] wavenumber = {forcing.wavenumber:g}: [initial] kind = "{initial.kind}" has no energy at '
               "0 < |k| < wavenumber, which linear forcing could amplify; start from another flow, raise wavenumber, "
               "or remove [forcing]")


def weights(scene: Scene, comm: Comm) -> Iterator[str]:
    """Trained weights that are there, and of another model."""
    if scene.model is None or scene.model.path is None or not on_first_rank(comm, scene.model.weights_file.is_file):
        return
    from eddies.workflows.learned.source import read_source  # torch, where there is a model
    try:
        read_source(scene, comm)
    except UserError as error:
        yield str(error)


def truths(scene: Scene, comm: Comm) -> list[str]:
    """Ground truths that the model cannot be trained on."""
    if scene.training is None or scene.training.truths is None:
        return []
    from eddies.workflows.learned.truths import truth_problems  # torch, where there is a model
    return truth_problems(scene, comm, scene.directory)


def single_writer(stages: Sequence[str], scene: Scene, comm: Comm) -> Iterator[str]:
    """Products that are too large for rank 0 to write for all."""
    if not has_single_writer(comm):
        return
    for stage, size in product_bytes(scene).items():
        if stage in stages and size > LARGEST_BYTES:
            yield (f"{STAGES[stage].file}: this h5py is built without MPI, so that rank 0 writes for {comm.size} "
                   f"ranks, up to {in_units(LARGEST_BYTES)} a file, and this will take {in_units(size)}; {REMEDY}")


def memory(comm: Comm, costs: Sequence[StageCost]) -> Iterator[str]:
    """More memory than the ranks of this node have together."""
    ranks, there = node_ranks(comm), os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    for cost in costs:
        if ranks * cost.memory > there:
            yield (f"{cost.stage}: {ranks} ranks with about {in_units(cost.memory)} each need more than the "
                   f"{in_units(there)} of memory here; take more nodes, or fewer cells or particles")


def disk(comm: Comm, costs: Sequence[StageCost]) -> Iterator[str]:
    """More disk than is free where run directories are, unless --output says otherwise."""
    place = Path("runs") if Path("runs").is_dir() else Path()
    needed, free = totals(costs)["most_disk"], on_first_rank(comm, lambda: shutil.disk_usage(place).free)
    if needed > free:
        yield (f"the stages need about {in_units(needed)} of disk, and {in_units(free)} are free here; choose another "
               "--output, or raise [tracers] frame_interval or field_every")
