"""The cheapest time step of a rollout that has converged, found by short rollouts on the ground truth.

Every method goes by the same rule. For each integrator steps are halved from a generous one on. A step has converged if
a rollout with it and one with half of it end with velocities that differ, in the root mean square, by less than 2 % of
the error of the latter or 1e-4 of the velocity, whichever is larger. It must have converged on every further ground
truth that the scene names as well. Coarse grids have Courant numbers in place of steps. Of the steps that have
converged the cheapest is taken.

An integrator is given up once a step that could converge would cost more than the best one so far. That step is
foreseen from the last difference, as if it fell with the full order of the integrator, and the cost from its last rise.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from eddies.io.hdf5 import create_product, open_product, write_attributes, write_table
from eddies.parallel.communicator import Comm
from eddies.parallel.migration import IdOrder
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.parallel.stop import StopRequest
from eddies.particles.devices import prepare_torch
from eddies.pipeline import STAGES
from eddies.scene.integrators import SCHEMES
from eddies.scene.scene import BOX_LENGTH, Scene, SceneError
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.rollout.method_of_step import METHODS, Step, method_of_step

log = logging.getLogger("eddies")

TURNOVERS = 0.25  # of a short rollout
# A step has converged if halving it changes the end by less than this share of the error, or of the velocity.
OF_ERROR, OF_VELOCITY = 0.02, 1e-4
# How often a step is halved, and the Courant number that grids begin with: twice the limit of stability.
HALVINGS, COURANT = 12, 2.8


@dataclass(frozen=True)
class Trial:
    """A short rollout.

    Parameters
    ----------
    step : its step. seconds : of a turnover, without storing.
    error, difference : rms of the velocity at the end less the true one, and less that with twice the step, over that
        of the true one; nan where there is no such end.
    """

    step: Step
    seconds: float
    error: float = np.nan
    difference: float = np.nan

    @property
    def tolerance(self) -> float:
        """The difference below which twice the step has converged."""
        return max(OF_ERROR * self.error, OF_VELOCITY)


def run(scene: Scene, comm: Comm, directory: str | Path, stop: StopRequest | None = None) -> None:
    """Find the step of a scene's rollout and write step.h5.

    Raises SceneError where no step has converged.
    """
    device, directory, began = prepare_torch(scene.device, comm), Path(directory), time.perf_counter()
    slab = SlabDecomposition(comm, BOX_LENGTH, scene.tracers.planes)
    paths = [directory / STAGES["dns"].file, *scene.simulation.confirming_files]
    with ExitStack() as files, torch.no_grad():
        truths = [GroundTruth(files.enter_context(open_product(comm, path, "ground_truth")), slab) for path in paths]
        for path, truth in zip(paths, truths):
            if truth.total != truths[0].total:
                raise SceneError(f"{scene.name}: [simulation] confirmed_on: {path} holds {truth.total} particles, not "
                                 f"{truths[0].total}; name a run with as many")
        search = _Search(scene, truths, directory, device, stop or StopRequest(comm))
        found, half = search.cheapest()
    seconds = time.perf_counter() - began
    with create_product(comm, directory / "step.h5", "step", scene.provenance("find-step")) as file:
        write_attributes(file.create_group("found"), {
            "integrator": found.step.integrator, "size": found.step.size, "seconds_per_turnover": found.seconds,
            "error": found.error, "error_with_half": half.error, "difference": half.difference,
            "tolerance": half.tolerance, "seconds": seconds, "confirmed_on": len(truths) - 1,
            "turnovers": search.span / search.turnover})
        for name in dict.fromkeys(trial.step.integrator for trial in search.trials):
            own = [trial for trial in search.trials if trial.step.integrator == name]
            write_table(file, f"trials/{name}", {
                "size": [trial.step.size for trial in own], "seconds_per_turnover": [trial.seconds for trial in own],
                "error": [trial.error for trial in own], "difference": [trial.difference for trial in own]})
    log.info("find-step: %s, %s %.4g, %.3g s a turnover; halving it changes %.4f of an error of %.4f",
             found.step.integrator, "Courant number" if scene.simulation.on_grid else "step", found.step.size,
             found.seconds, half.difference, half.error)


class _Start:
    """The part of a ground truth that short rollouts go through: from the first frame at which the whole flow is
    stored, or from the second frame, in whole frame intervals of the rollout."""

    def __init__(self, truth: GroundTruth, scene: Scene) -> None:
        self.truth, self.turnover = truth, float(truth.reference["eddy_turnover_time"])
        whole = [int(np.argmin(np.abs(truth.times - at))) for at in truth.states.times]
        self.frame = min((frame for frame in whole if frame > 0), default=1)
        interval = scene.simulation.frame_interval
        frames = round(interval / scene.tracers.frame_interval)
        most = (len(truth.times) - 1 - self.frame) // frames
        count = min(max(round(TURNOVERS * self.turnover / interval), 1), most)
        self.stops = np.arange(1, count + 1) * interval
        self.end = truth.block(self.frame + count * frames, ("velocity",))["velocity"]


class _Search:
    """Short rollouts of a scene on ground truths. The first is searched, and `trials` are all that were made there."""

    def __init__(self, scene: Scene, truths: Sequence[GroundTruth], directory: Path, device: torch.device,
                 stop: StopRequest) -> None:
        self.scene, self.directory, self.device, self.stop = scene, directory, device, stop
        self.comm = truths[0].decomposition.comm
        self.start, *self._others = (_Start(truth, scene) for truth in truths)
        self.span, self.turnover = float(self.start.stops[-1]), self.start.turnover
        self.trials: list[Trial] = []

    def cheapest(self) -> tuple[Trial, Trial]:
        """The cheapest trial whose step has converged, and that with half of it."""
        best: tuple[Trial, Trial] | None = None
        for name, first, order in self._ladders():
            before, velocity = None, None
            for halved in range(HALVINGS):
                trial, ended = self._try(self.start, Step(name, first / 2**halved), velocity)
                self.trials.append(trial)
                if before is not None and trial.difference < trial.tolerance and self._confirmed(before, trial):
                    if best is None or before.seconds < best[0].seconds:
                        best = before, trial
                    break
                if best is not None and ended is not None and _foreseen(before, trial, order) > best[0].seconds:
                    break
                before, velocity = (trial, ended) if ended is not None else (None, None)
        if best is None:
            smallest = min(trial.step.size for trial in self.trials)
            raise SceneError(f'{self.scene.name}: [simulation] step = "converged": none has converged down to '
                             f"{smallest:.2g}; give a number")
        return best

    def _confirmed(self, whole: Trial, half: Trial) -> bool:
        """Whether a step that has converged has done so on the other ground truths as well."""
        for number, start in enumerate(self._others, 1):
            _, coarser = self._try(start, whole.step, None)
            trial, ended = self._try(start, half.step, coarser)
            if coarser is None or ended is None or not trial.difference < trial.tolerance:
                log.info("find-step: %s %.4g has not converged on ground truth %d of %d", whole.step.integrator,
                         whole.step.size, number, len(self._others))
                return False
        return True

    def _ladders(self) -> Iterator[tuple[str, float, int]]:
        """The integrators, each with its first step and its order."""
        settings = self.scene.simulation
        if settings.on_grid:
            yield "etdrk4", COURANT, 4
            return
        # A method of the user's steps in its own way, whatever the integrator.
        for name in settings.schemes if settings.method in METHODS else settings.schemes[:1]:
            scheme = SCHEMES[name]
            yield name, self.span if scheme.dense else self.scene.simulation.frame_interval, scheme.order

    def _try(self, start: _Start, step: Step, coarser: np.ndarray | None) -> tuple[Trial, np.ndarray | None]:
        """A short rollout with a step, and the velocities at its end in order of id; None where it went wrong.
        `coarser`: those with twice the step."""
        method = method_of_step(self.scene, step, start.truth, start.frame, self.directory, self.device)
        method.frame(0.0)  # the rates with which the first step begins
        began, number, complaint = time.perf_counter(), 0, None
        for until in start.stops:
            while complaint is None and method.time < until - 1e-9 * start.stops[0]:
                self.stop.check()
                number += 1
                complaint = method.advance(until, number)
        seconds = self.comm.bcast((time.perf_counter() - began) * start.turnover / max(method.time, 1e-300))
        if complaint is not None:
            log.info("find-step: %s %.4g: %s", step.integrator, step.size, complaint)
            return Trial(step, seconds), None
        particles, _ = method.frame(float(start.stops[-1]))
        columns = particles.to_numpy()
        velocity = IdOrder(self.comm, columns["id"], start.truth.total).apply(columns["velocity"])
        error = self._distance(velocity, start.end, start.end)
        difference = np.nan if coarser is None else self._distance(velocity, coarser, start.end)
        log.info("find-step: %s %.4g: error %.4f, difference from twice the step %.5f, %.3g s a turnover",
                 step.integrator, step.size, error, difference, seconds)
        return Trial(step, seconds, error, difference), velocity

    def _distance(self, one: np.ndarray, other: np.ndarray, true: np.ndarray) -> float:
        """Rms of the difference of two velocities, over that of a true one."""
        sums = np.array([np.sum((one.astype(np.float64) - other) ** 2), np.sum(true.astype(np.float64) ** 2)])
        square, size = global_sum(self.comm, sums)
        return float(np.sqrt(square / size))


def _foreseen(before: Trial | None, trial: Trial, order: int) -> float:
    """The least that the converged step of an integrator can cost, by its last two trials; of one alone its own cost,
    as a finer step costs at least as much."""
    if before is None or not trial.difference > 0:
        return trial.seconds
    halvings = max(np.ceil(np.log2(trial.difference / trial.tolerance) / order), 0.0)
    # The step that converges is twice the one whose difference is small enough.
    return before.seconds * max(trial.seconds / before.seconds, 1.0) ** halvings
