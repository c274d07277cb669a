"""The ground truths that a model is trained on: that of the run itself, or those that [training] truths names."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import torch

from eddies.errors import UserError
from eddies.io.hdf5 import File, open_product
from eddies.parallel.communicator import Comm
from eddies.scene.rules import quoted
from eddies.scene.scene import Tracers, Training
from eddies.workflows.ground_truth.frame_counts import trained_frames
from eddies.workflows.ground_truth.truth import GroundTruth, open_truth


@contextmanager
def open_truths(own_file: Path, named: Sequence[Path], comm: Comm,
                device: torch.device) -> Iterator[tuple[GroundTruth, list[GroundTruth]]]:
    """Open the ground truth of a run, and those for training, whose files are `named`; collective.

    Yields the ground truth of the run, and the list of the ground truths for training. If `named` is empty, this list
    holds the ground truth of the run.
    """
    with ExitStack() as files:
        own = files.enter_context(open_truth(comm, own_file, device))
        yield own, [own if path.resolve() == own_file.resolve() else files.enter_context(open_truth(comm, path, device))
                    for path in named or (own_file,)]


def truth_problems(settings: Training, tracers: Tracers, reads: Collection[str], own_file: Path,
                   comm: Comm) -> list[str]:
    """Return the reasons why [training] truths cannot be used with terms that read the inputs `reads`. Collective.

    Each reason is one line. The file of the run's own ground truth, `own_file`, is not examined: it may not exist yet.
    """
    own, problems, seen = own_file.resolve(), [], set()
    for name, path in zip(settings.truths or (), settings.truth_files):
        place, file = f"[training] truths: {quoted(name)}", path.resolve()
        if file in seen:
            problems.append(f"{place}: is named twice; name each ground truth once")
        elif file != own:
            try:
                with open_product(comm, path, "ground_truth") as opened:
                    found = _problems_of(opened, settings, tracers, reads, comm)
                    problems += [f"{place}: {problem}" for problem in found]
            except UserError as error:
                problems.append(f"{place}: {error}")
        seen.add(file)
    return problems


def _problems_of(file: File, settings: Training, tracers: Tracers, reads: Collection[str],
                 comm: Comm) -> Iterator[str]:
    """Yield the reasons why an open ground truth of another run does not fit [training], [tracers] and the inputs
    `reads`."""
    if "particles/tracers" not in file:
        yield "holds no tracers to learn from; give the run of a scene with [tracers]"
        return
    truth = GroundTruth(file, comm)
    scales = truth.scales
    own_ratio, other_ratio = tracers.filter_width / tracers.spacing, scales.filter_width / scales.spacing
    if not math.isclose(own_ratio, other_ratio, rel_tol=1e-6):
        yield (f"its filter is {other_ratio:.9g} mean spacings wide, but [tracers] filter_width = "
               f"{tracers.filter_width:.9g} is {own_ratio:.9g} mean spacings; give another run, or set filter_width = "
               f"{other_ratio * tracers.spacing:.9g}")
    if "density" in reads and not truth.has_density:
        yield ("holds no density, which the terms of [model] read; give a run of a compressible flow, or remove these "
               "terms")
    if settings.batch > truth.total:
        yield f"holds {truth.total} particles, fewer than [training] batch = {settings.batch}; lower batch"
    if settings.field_weight > 0 and not math.isclose(tracers.spacing, scales.spacing, rel_tol=1e-6):
        yield (f"its particles have a mean spacing of {scales.spacing:.4g}, but [training] field_weight = "
               f"{settings.field_weight:g} needs the spacing of the kernel, {tracers.spacing:.4g}; remove "
               "field_weight, or give another run")
    interval = float(truth.times[1] - truth.times[0])
    if settings.horizons and not math.isclose(tracers.frame_interval, interval, rel_tol=1e-6):
        yield (f"its frames are {interval:.6g} apart, but [training.horizons] counts frames of [tracers] "
               f"frame_interval = {tracers.frame_interval:g}; make both equal, or remove [training.horizons]")
    trained_frames(settings, len(truth.times), truth.field_frames)
