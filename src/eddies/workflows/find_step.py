"""The cheapest time step of a rollout that has converged, found by short rollouts on the ground truth.

Every method goes by the same rule. Steps of each integrator differ by factors of two. Two rollouts are compared, one
with the step and one with half of it. The difference of their final velocities (rms) is taken as the error that the
step adds. The step has converged if this raises the error by less than 2 %, or is less than 1e-4 of the velocity.
Independent errors add as squares, so the difference may be a fifth of the error. A step must also converge on every
further ground truth that the scene names. Coarse grids have Courant numbers in place of steps. The cheapest step that
has converged is taken.

The steps of the first integrator are halved until one has converged. Those of the others are doubled, from the shortest
one that needs no more evaluations than the best so far, for as long as they end within the tolerance of where that ends
with half its step. An integrator whose shortest such step ends farther away is given up: longer ones end farther still.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
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
from eddies.scene.integrators import MOST_COURANT, SCHEMES
from eddies.scene.scene import BOX_LENGTH, Scene, SceneError
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.rollout.method_of_step import METHODS, Step, method_of_step
from eddies.workflows.run_directory.fingerprints import stage_provenance

log = logging.getLogger("eddies")

TURNOVERS = 0.25  # of a short rollout
# The share of the error that a step may add, and the share of the velocity that it may change in any case.
OF_ERROR, OF_VELOCITY = 0.02, 1e-4
# How often a step is halved at most.
HALVINGS = 12
# Another integrator takes the place of the best one if it needs less than this share of its time: times are uncertain.
CHEAPER = 0.9


@dataclass(frozen=True)
class Trial:
    """A short rollout.

    Parameters
    ----------
    step : its step. seconds : of a turnover, without storing.
    velocity : at the end, in order of id; None where it went wrong.
    error : rms of that velocity less the true one, over that of the true one; nan without an end.
    """

    step: Step
    seconds: float
    velocity: np.ndarray | None = None
    error: float = np.nan

    @property
    def tolerance(self) -> float:
        """The difference d below which twice the step has converged: e^2 + d^2 = (1.02 e)^2 with the error e."""
        return max(math.sqrt((1 + OF_ERROR) ** 2 - 1) * self.error, OF_VELOCITY)


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
        ladder, rung = search.cheapest()
        found, half, difference = ladder[rung], ladder[rung + 1], search.difference(ladder, rung + 1)
        tables = {ladder.integrator: search.table(ladder) for ladder in search.ladders if ladder.trials}
    seconds = time.perf_counter() - began
    with create_product(comm, directory / "step.h5", "step", stage_provenance(scene, "find-step")) as file:
        write_attributes(file.create_group("found"), {
            "integrator": found.step.integrator, "size": found.step.size, "seconds_per_turnover": found.seconds,
            "error": found.error, "error_with_half": half.error, "difference": difference,
            "tolerance": half.tolerance, "seconds": seconds, "confirmed_on": len(truths) - 1,
            "turnovers": search.span / search.turnover})
        for name, table in tables.items():
            write_table(file, f"trials/{name}", table)
    log.info("find-step: %s, %s %.4g, %.3g s a turnover; halving it changes %.4f of an error of %.4f",
             found.step.integrator, "Courant number" if scene.simulation.on_grid else "step", found.step.size,
             found.seconds, difference, half.error)


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


class _Ladder:
    """Short rollouts with an integrator, made when they are asked for: rung 0 has the longest step, each other one half
    of that before.

    Parameters
    ----------
    make : what makes a rollout with a step.
    evaluations : of the rates in a step.
    trials : those that have been made, by rung.
    """

    def __init__(self, make: Callable[[Step], Trial], integrator: str, first: float, evaluations: int) -> None:
        self._make, self.integrator, self._first, self.evaluations = make, integrator, first, evaluations
        self.trials: dict[int, Trial] = {}

    def step(self, rung: int) -> Step:
        """The step of a rung."""
        return Step(self.integrator, self._first / 2**rung)

    def __getitem__(self, rung: int) -> Trial:
        if rung not in self.trials:
            self.trials[rung] = self._make(self.step(rung))
        return self.trials[rung]


class _Search:
    """Short rollouts of a scene on ground truths, of which the first is searched."""

    def __init__(self, scene: Scene, truths: Sequence[GroundTruth], directory: Path, device: torch.device,
                 stop: StopRequest) -> None:
        self.scene, self.directory, self.device, self.stop = scene, directory, device, stop
        self.comm = truths[0].decomposition.comm
        self.start, *self._others = (_Start(truth, scene) for truth in truths)
        self.span, self.turnover = float(self.start.stops[-1]), self.start.turnover
        self.ladders = [_Ladder(partial(self._try, self.start), *rungs) for rungs in self._integrators()]

    def cheapest(self) -> tuple[_Ladder, int]:
        """The rung with the cheapest step that has converged, and its ladder."""
        best: tuple[_Ladder, int] | None = None
        for ladder in self.ladders:
            if best is None:
                rung = next((rung for rung in range(HALVINGS) if self._converged(ladder, rung)), None)
            else:
                rung = self._cheaper(ladder, *best)
            best = best if rung is None else (ladder, rung)
        if best is None:
            smallest = min(trial.step.size for ladder in self.ladders for trial in ladder.trials.values())
            raise SceneError(f'{self.scene.name}: [simulation] step = "converged": none has converged down to '
                             f"{smallest:.2g}; give a number")
        return best

    def difference(self, ladder: _Ladder, rung: int) -> float:
        """Rms of the velocity at the end less that with twice the step, over that of the true one; nan where one of
        them was not tried or has no end."""
        return self._distance(ladder.trials.get(rung), ladder.trials.get(rung - 1), self.start)

    def table(self, ladder: _Ladder) -> dict[str, list[float]]:
        """The trials of a ladder, the longest step first."""
        rungs = sorted(ladder.trials)
        trials = [ladder.trials[rung] for rung in rungs]
        return {"size": [trial.step.size for trial in trials],
                "seconds_per_turnover": [trial.seconds for trial in trials],
                "error": [trial.error for trial in trials],
                "difference": [self.difference(ladder, rung) for rung in rungs]}

    def _cheaper(self, ladder: _Ladder, best: _Ladder, of_best: int) -> int | None:
        """The longest step of a ladder that has converged, if it costs less than the best one so far."""
        most = best.evaluations / best.step(of_best).size
        shortest = max((rung for rung in range(HALVINGS) if ladder.evaluations / ladder.step(rung).size <= most),
                       default=-1)
        most_seconds = CHEAPER * best[of_best].seconds
        # Evaluations differ in cost: of a corrected Verlet step, or where a solve starts from a good guess.
        while 0 <= shortest < HALVINGS and 2 * ladder[shortest].seconds < most_seconds:
            shortest += 1
        rung, right = shortest, best[of_best + 1]
        while rung >= 0 and self._distance(ladder[rung], right, self.start) <= right.tolerance:
            rung -= 1
        return next((rung for rung in range(rung + 1, shortest + 1)
                     if ladder[rung].seconds < most_seconds and self._converged(ladder, rung)), None)

    def _converged(self, ladder: _Ladder, rung: int) -> bool:
        """Whether a step has converged on all ground truths."""
        whole, half = ladder[rung], ladder[rung + 1]
        if not self._distance(whole, half, self.start) < half.tolerance:
            return False
        for number, start in enumerate(self._others, 1):
            coarser, finer = self._try(start, whole.step), self._try(start, half.step)
            if not self._distance(coarser, finer, start) < finer.tolerance:
                log.info("find-step: %s %.4g has not converged on ground truth %d of %d", whole.step.integrator,
                         whole.step.size, number, len(self._others))
                return False
        return True

    def _integrators(self) -> Iterator[tuple[str, float, int]]:
        """Those that are searched, each with its first step and its evaluations in a step."""
        settings = self.scene.simulation
        if settings.on_grid:
            yield "etdrk4", MOST_COURANT, 4
            return
        # A method of the user's steps in its own way, whatever the integrator.
        for name in settings.schemes if settings.method in METHODS else settings.schemes[:1]:
            scheme = SCHEMES[name]
            yield name, self.span if scheme.dense else self.scene.simulation.frame_interval, scheme.evaluations

    def _try(self, start: _Start, step: Step) -> Trial:
        """A short rollout with a step."""
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
            return Trial(step, seconds)
        particles, _ = method.frame(float(start.stops[-1]))
        columns = particles.to_numpy()
        velocity = IdOrder(self.comm, columns["id"], start.truth.total).apply(columns["velocity"])
        error = self._rms(velocity, start.end, start)
        log.info("find-step: %s %.4g: error %.4f, %.3g s a turnover", step.integrator, step.size, error, seconds)
        return Trial(step, seconds, velocity, error)

    def _distance(self, one: Trial | None, other: Trial | None, start: _Start) -> float:
        """Between the ends of two trials, over the rms of the true velocity; nan without one of them."""
        if one is None or other is None or one.velocity is None or other.velocity is None:
            return np.nan
        return self._rms(one.velocity, other.velocity, start)

    def _rms(self, one: np.ndarray, other: np.ndarray, start: _Start) -> float:
        """Rms of the difference of two velocities, over that of the true one at the end."""
        sums = np.array([np.sum((one.astype(np.float64) - other) ** 2), np.sum(start.end.astype(np.float64) ** 2)])
        square, size = global_sum(self.comm, sums)
        return float(np.sqrt(square / size))
