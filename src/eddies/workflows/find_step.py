"""The cheapest time step of a rollout that has converged, found by short rollouts on the ground truth.

Every method goes by the same rule. For each integrator steps are halved from a generous one on. A step has converged if
a rollout with it and one with half of it end with velocities that differ, in the root mean square, by less than 2 % of
the error of the latter or 1e-4 of the velocity, whichever is larger. Coarse grids have Courant numbers in place of
steps. Of the steps that have converged the cheapest is taken.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
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
    with open_product(comm, directory / "ground_truth.h5", "ground_truth") as file, torch.no_grad():
        search = _Search(scene, GroundTruth(file, slab), directory, device, stop or StopRequest(comm))
        found, half = search.cheapest()
    seconds = time.perf_counter() - began
    with create_product(comm, directory / "step.h5", "step", scene.provenance("find-step")) as file:
        write_attributes(file.create_group("found"), {
            "integrator": found.step.integrator, "size": found.step.size, "seconds_per_turnover": found.seconds,
            "error": found.error, "error_with_half": half.error, "difference": half.difference,
            "tolerance": half.tolerance, "seconds": seconds,
            "turnovers": search.span / search.turnover})
        for name in dict.fromkeys(trial.step.integrator for trial in search.trials):
            own = [trial for trial in search.trials if trial.step.integrator == name]
            write_table(file, f"trials/{name}", {
                "size": [trial.step.size for trial in own], "seconds_per_turnover": [trial.seconds for trial in own],
                "error": [trial.error for trial in own], "difference": [trial.difference for trial in own]})
    log.info("find-step: %s, %s %.4g, %.3g s a turnover; halving it changes %.4f of an error of %.4f",
             found.step.integrator, "Courant number" if scene.simulation.on_grid else "step", found.step.size,
             found.seconds, half.difference, half.error)


class _Search:
    """Short rollouts of a scene from the first frame of the truth at which the whole flow is stored, or from its second
    frame; `trials` are all that were made."""

    def __init__(self, scene: Scene, truth: GroundTruth, directory: Path, device: torch.device,
                 stop: StopRequest) -> None:
        self.scene, self.truth, self.directory, self.device, self.stop = scene, truth, directory, device, stop
        self.comm, self.turnover = truth.decomposition.comm, float(truth.reference["eddy_turnover_time"])
        self.interval = scene.simulation.frame_interval
        whole = [int(np.argmin(np.abs(truth.times - at))) for at in truth.states.times]
        self.start = min((frame for frame in whole if frame > 0), default=1)
        # Whole frame intervals, as rollouts take them.
        frames = round(self.interval / scene.tracers.frame_interval)
        most = (len(truth.times) - 1 - self.start) // frames
        count = min(max(round(TURNOVERS * self.turnover / self.interval), 1), most)
        self.span, self.end = count * self.interval, self.start + count * frames
        self.trials: list[Trial] = []
        self._true = truth.block(self.end, ("velocity",))["velocity"]

    def cheapest(self) -> tuple[Trial, Trial]:
        """The cheapest trial whose step has converged, and that with half of it."""
        best: tuple[Trial, Trial] | None = None
        for name, first in self._ladders():
            before, velocity = None, None
            for halved in range(HALVINGS):
                trial, ended = self._try(Step(name, first / 2**halved), velocity)
                self.trials.append(trial)
                if before is not None and trial.difference < trial.tolerance:
                    if best is None or before.seconds < best[0].seconds:
                        best = before, trial
                    break
                # A finer step costs at least as much as this one.
                if best is not None and trial.seconds > best[0].seconds and ended is not None:
                    break
                before, velocity = (trial, ended) if ended is not None else (None, None)
        if best is None:
            smallest = min(trial.step.size for trial in self.trials)
            raise SceneError(f'{self.scene.name}: [simulation] step = "converged": none has converged down to '
                             f"{smallest:.2g}; give a number")
        return best

    def _ladders(self) -> Iterator[tuple[str, float]]:
        """The integrators, each with its first step."""
        settings = self.scene.simulation
        if settings.on_grid:
            yield "etdrk4", COURANT
            return
        # A method of the user's steps in its own way, whatever the integrator.
        for name in settings.schemes if settings.method in METHODS else settings.schemes[:1]:
            yield name, self.span if SCHEMES[name].dense else self.interval

    def _try(self, step: Step, coarser: np.ndarray | None) -> tuple[Trial, np.ndarray | None]:
        """A short rollout with a step, and the velocities at its end in order of id; None where it went wrong.
        `coarser`: those with twice the step."""
        method = method_of_step(self.scene, step, self.truth, self.start, self.directory, self.device)
        method.frame(0.0)  # the rates with which the first step begins
        began, number, complaint = time.perf_counter(), 0, None
        for until in np.arange(1, round(self.span / self.interval) + 1) * self.interval:
            while complaint is None and method.time < until - 1e-9 * self.interval:
                self.stop.check()
                number += 1
                complaint = method.advance(until, number)
        seconds = self.comm.bcast((time.perf_counter() - began) * self.turnover / max(method.time, 1e-300))
        if complaint is not None:
            log.info("find-step: %s %.4g: %s", step.integrator, step.size, complaint)
            return Trial(step, seconds), None
        particles, _ = method.frame(self.span)
        columns = particles.to_numpy()
        velocity = IdOrder(self.comm, columns["id"], self.truth.total).apply(columns["velocity"])
        error = self._distance(velocity, self._true)
        difference = np.nan if coarser is None else self._distance(velocity, coarser)
        log.info("find-step: %s %.4g: error %.4f, difference from twice the step %.5f, %.3g s a turnover",
                 step.integrator, step.size, error, difference, seconds)
        return Trial(step, seconds, error, difference), velocity

    def _distance(self, one: np.ndarray, other: np.ndarray) -> float:
        """Rms of the difference of two velocities, over that of the true one."""
        sums = np.array([np.sum((one.astype(np.float64) - other) ** 2), np.sum(self._true.astype(np.float64) ** 2)])
        square, true = global_sum(self.comm, sums)
        return float(np.sqrt(square / true))
