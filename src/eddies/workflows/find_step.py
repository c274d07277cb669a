"""Find the cheapest converged time step of a rollout, by short rollouts on the ground truth.

The rule is the same for every method. The steps of an integrator differ by factors of two. Each step is compared with
half of it. The distance d is the rms difference between the final velocities of these two rollouts. The error e is the
rms difference between the final velocity with the half step and the true one. Both are divided by the rms of the true
velocity. The whole step is assumed to add an independent error d, so the square of its error is e^2 + d^2. The step has
converged if d is below a fifth of e, so that e^2 + d^2 < (1.02 e)^2, or if d is below 1e-3. A step must also converge
on all ground truths in [simulation] confirmed_on. For coarse grids a Courant number takes the place of the step. The
cheapest converged step is stored.

The steps of the first integrator are halved until one has converged. The search with each other integrator starts at
the shortest step that needs no more evaluations than the best step so far. The reference is the rollout with half the
best step. The step is doubled as long as the final velocity differs from that of the reference by at most the
tolerance. If already the shortest step differs by more, this search ends at once, because longer steps are less
accurate.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from eddies.clock import ROUND_OFF
from eddies.import_path import is_path
from eddies.io.hdf5 import Table, create_product, write_table
from eddies.io.new_files import set_attributes
from eddies.parallel.communicator import Comm
from eddies.parallel.migration import IdOrder
from eddies.parallel.step_times import StepTimes
from eddies.parallel.stop import StopRequest
from eddies.particles.devices import prepare_torch
from eddies.particles.exchanges import fluctuations, relative_error
from eddies.particles.flow_units import ReferenceScales
from eddies.pipeline import STAGES
from eddies.scene.integrators import SCHEMES
from eddies.scene.scene import Scene, SceneError
from eddies.time_stepping import ETDRK4
from eddies.workflows.ground_truth.truth import GroundTruth, open_truth
from eddies.workflows.learned.source import ModelDefinition
from eddies.workflows.rollout.method import Method, TimeStep, allowed_by_terms, make_method
from eddies.workflows.run_directory.fingerprints import stage_provenance

log = logging.getLogger("eddies")

TURNOVERS = 0.25  # duration of a short rollout in turnover times
# Largest share of the error that a step may add, and the relative change of the velocity that is always allowed.
LARGEST_ERROR_SHARE, LEAST_TOLERANCE = 0.02, 1e-3
# Largest number of halvings of a step.
HALVINGS = 12
# Another integrator replaces the best one only if it needs less than this share of the best one's time, because
# measured times vary.
CHEAPER = 0.9


class Stretch:
    """The part of a ground truth that short rollouts cover, in whole frame intervals of the rollout.

    It starts at the first frame after frame 0 that has the unfiltered flow, or at frame 1 if there is none.

    Parameters
    ----------
    interval, every : the frame interval of the rollout, in units of time and in frames of the ground truth.
    name : words for the log that name the ground truth; empty if there is only one.
    """

    def __init__(self, truth: GroundTruth, interval: float, every: int, name: str) -> None:
        self.truth, self.turnover, self.name = truth, float(truth.reference["eddy_turnover_time"]), name
        self.frame = min((frame for frame in truth.state_frames if frame > 0), default=1)
        most = (len(truth.times) - 1 - self.frame) // every
        if most < 1:
            raise SceneError(f"[simulation] frame_interval = {interval:g}: the search for the step needs one such "
                             f"interval after t = {truth.times[self.frame]:.3g}, but a ground truth ends at "
                             f"{truth.times[-1]:.3g}; lower frame_interval, or raise [tracers] turnovers")
        count = min(max(round(TURNOVERS * self.turnover / interval), 1), most)
        self.stops = np.arange(1, count + 1) * interval
        self.end = truth.block(self.frame + count * every, ("velocity",))["velocity"]

    def distance(self, one: np.ndarray, other: np.ndarray) -> float:
        """Return the rms difference of two final velocities over the rms fluctuation of the true one; collective."""
        comm = self.truth.decomposition.comm
        return relative_error(comm, torch.from_numpy(one.astype(np.float64) - other),
                              fluctuations(comm, torch.from_numpy(self.end)))


@dataclass(frozen=True)
class Trial:
    """A short rollout with one time step.

    Parameters
    ----------
    stretch : the part of a ground truth that the rollout covers.
    seconds : wall time per turnover time of the flow; nothing is stored.
    velocity : the final velocity in order of id; None if the rollout failed.
    timed : numbers of `StepTimes` on its steps.
    """

    stretch: Stretch
    step: TimeStep
    seconds: float
    velocity: np.ndarray | None = None
    timed: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def error(self) -> float:
        """Distance of the final velocity from the true one; nan if the rollout failed. The first use is collective."""
        return np.nan if self.velocity is None else self.stretch.distance(self.velocity, self.stretch.end)

    def distance(self, other: Trial | None) -> float:
        """Return the distance of the final velocities of two trials; collective. It is nan if the trial `other` is
        missing, or if one of the two failed."""
        if other is None or other.velocity is None or self.velocity is None:
            return np.nan
        return self.stretch.distance(self.velocity, other.velocity)

    @property
    def tolerance(self) -> float:
        """The rollout with twice this step has converged if its distance from this rollout is less than this number:
        sqrt(1.02^2 - 1) times `error`, at least 1e-3."""
        return max(math.sqrt((1 + LARGEST_ERROR_SHARE) ** 2 - 1) * self.error, LEAST_TOLERANCE)


class Ladder:
    """Short rollouts with one integrator. Their steps are the rungs of a ladder: rung 0 is the longest step, and each
    further rung is half the step before it.

    Parameters
    ----------
    tried : function that runs the rollout on a stretch with a step. It is called when a rung is first needed.
    stretches : one for each ground truth. The search uses the first. A step must converge on the others, too.
    integrator, first, evaluations : name of the integrator, longest step, and evaluations of the rates in a step.
    """

    def __init__(self, tried: Callable[[Stretch, TimeStep], Trial], stretches: Sequence[Stretch], integrator: str,
                 first: float, evaluations: int) -> None:
        self._tried, self._stretches, self.integrator = tried, stretches, integrator
        self._first, self.evaluations = first, evaluations
        self.trials: dict[int, Trial] = {}  # by rung

    def size(self, rung: int) -> float:
        """Return the step of a rung."""
        return self._first / 2**rung

    def __getitem__(self, rung: int) -> Trial:
        if rung not in self.trials:
            self.trials[rung] = self._tried(self._stretches[0], TimeStep(self.integrator, self.size(rung)))
        return self.trials[rung]

    def difference(self, rung: int) -> float:
        """Return the distance between the rollout on a rung and the one with twice its step; nan if the rollout with
        twice the step was not tried."""
        return self[rung].distance(self.trials.get(rung - 1))

    def table(self) -> dict[str, list[float]]:
        """Return the columns of the table of trials. The first row belongs to the longest step."""
        trials = {rung: self.trials[rung] for rung in sorted(self.trials)}
        return {"size": [trial.step.size for trial in trials.values()],
                "seconds_per_turnover": [trial.seconds for trial in trials.values()],
                "error": [trial.error for trial in trials.values()],
                "difference": [self.difference(rung) for rung in trials]}

    def converged(self, rung: int) -> bool:
        """Return whether the step of a rung has converged on all ground truths."""
        whole, half = self[rung], self[rung + 1]
        if not whole.distance(half) < half.tolerance:
            return False
        for stretch in self._stretches[1:]:
            coarser, finer = (self._tried(stretch, trial.step) for trial in (whole, half))
            if not coarser.distance(finer) < finer.tolerance:
                log.info("find-step: %s %.4g has not converged%s", self.integrator, whole.step.size, stretch.name)
                return False
        return True


def cheapest(ladders: Sequence[Ladder]) -> tuple[Ladder, int] | None:
    """Return the ladder and the rung of the cheapest converged step; None if no step converges."""
    best: tuple[Ladder, int] | None = None
    for ladder in ladders:
        if best is None:
            rung = next((rung for rung in range(HALVINGS) if ladder.converged(rung)), None)
        else:
            rung = cheaper(ladder, *best)
        best = best if rung is None else (ladder, rung)
    return best


def cheaper(ladder: Ladder, best: Ladder, of_best: int) -> int | None:
    """Return the rung of the longest step in `ladder` that converges and is cheaper than the rung `of_best` of `best`;
    None if there is none."""
    most = best.evaluations / best.size(of_best)
    shortest = max((rung for rung in range(HALVINGS) if ladder.evaluations / ladder.size(rung) <= most), default=-1)
    most_seconds = CHEAPER * best[of_best].seconds
    # A shorter step may still be cheaper, because the cost of an evaluation varies: a corrected Verlet step, or a solve
    # that starts from a good guess, is cheap.
    while 0 <= shortest < HALVINGS and 2 * ladder[shortest].seconds < most_seconds:
        shortest += 1
    rung, right = shortest, best[of_best + 1]
    while rung >= 0 and ladder[rung].distance(right) <= right.tolerance:
        rung -= 1
    return next((rung for rung in range(rung + 1, shortest + 1)
                 if ladder[rung].seconds < most_seconds and ladder.converged(rung)), None)


def run(scene: Scene, comm: Comm, directory: str | Path, stop: StopRequest | None = None) -> None:
    """Find the step of a scene's rollout and write step.h5.

    Raises SceneError if no step converges.
    """
    directory, settings, began = Path(directory), scene.simulation, time.perf_counter()
    device = prepare_torch(scene.device, comm)
    paths = [directory / STAGES["dns"].file, *settings.confirming_files]
    stop = stop or StopRequest(comm)

    def tried(stretch: Stretch, step: TimeStep) -> Trial:
        return short_rollout(make_method(scene, step, stretch.truth, stretch.frame, directory), step, stretch, stop)

    with ExitStack() as files, torch.no_grad():
        truths = [files.enter_context(open_truth(comm, path, device)) for path in paths]
        for path, truth in zip(paths, truths):
            if truth.total != truths[0].total:
                raise SceneError(f"{scene.name}: [simulation] confirmed_on: {path} holds {truth.total} particles, not "
                                 f"{truths[0].total}; name runs with the same number of particles")
        every = round(settings.frame_interval / scene.tracers.frame_interval)
        stretches = [Stretch(truth, settings.frame_interval, every,
                             f" on ground truth {number} of {len(truths)}" if len(truths) > 1 else "")
                     for number, truth in enumerate(truths, 1)]
        span = float(stretches[0].stops[-1])
        ladders = [Ladder(tried, stretches, *integrator)
                   for integrator in integrators(scene, truths[0].scales, span)]
        best = cheapest(ladders)
        if best is None:
            smallest = min(trial.step.size for ladder in ladders for trial in ladder.trials.values())
            raise SceneError(f'{scene.name}: [simulation] step = "converged": no step down to {smallest:.2g} has '
                             "converged; give the step as a number")
        ladder, rung = best
        found, half, difference = ladder[rung], ladder[rung + 1], ladder.difference(rung + 1)
        tables = {each.integrator: each.table() for each in ladders if each.trials}
    seconds = time.perf_counter() - began
    provenance = stage_provenance(scene, "find-step")
    with create_product(comm, directory / STAGES["find-step"].file, "step", provenance) as file:
        set_attributes(file.create_group("found"), {
            "integrator": found.step.integrator, "size": found.step.size, "seconds_per_turnover": found.seconds,
            "error": found.error, "error_with_half": half.error, "difference": difference,
            "tolerance": half.tolerance, "seconds": seconds, "confirmed_on": len(truths) - 1,
            "turnovers": span / stretches[0].turnover, **found.timed})
        for name, table in tables.items():
            write_table(file, f"trials/{name}", Table(table, units={
                "seconds_per_turnover": "s", **({} if settings.form.on_grid else {"size": "T"})}))
    log.info("find-step: found %s with %s %.4g, %.3g s per turnover. With half the value the final velocity "
             "differs by %.4f of its rms, and the error is %.4f", found.step.integrator,
             "Courant number" if settings.form.on_grid else "step", found.step.size, found.seconds, difference,
             half.error)


def integrators(scene: Scene, scales: ReferenceScales, span: float) -> Iterator[tuple[str, float, int]]:
    """Yield the name, the longest step and the evaluations in a step of each integrator to try.

    `scales` are those of the ground truth, and `span` is the duration of the short rollouts. Steps that a rollout would
    shorten for a term are left out.
    """
    settings = scene.simulation
    if settings.form.on_grid:
        yield "etdrk4", ETDRK4.most_courant, ETDRK4.evaluations
        return
    model = scene.model.settings if "model" in settings.form.needs else {}
    terms = [term for term in model.values() if term.follows_flow]
    # A method of the user ignores the integrator, so one is enough.
    for name in settings.schemes[:1] if is_path(settings.method) else settings.schemes:
        scheme = SCHEMES[name]
        longest = span if scheme.dense else settings.frame_interval
        if terms:
            allowed = allowed_by_terms(terms, ModelDefinition.of(scene).units(scales), scheme, scales.velocity)
            while longest > allowed * (1 + ROUND_OFF):
                longest /= 2
        yield name, longest, scheme.evaluations


def short_rollout(method: Method, step: TimeStep, stretch: Stretch, stop: StopRequest) -> Trial:
    """Advance a method through a stretch of the ground truth, and return the trial; collective.

    `step` is the step with which the method was made. Raises Stopped if a stop is requested.
    """
    comm, total = stretch.truth.decomposition.comm, stretch.truth.total
    method.frame(0.0)  # the rates at the start, which the first step uses
    began, number, complaint, timed = time.perf_counter(), 0, None, StepTimes()
    for until in stretch.stops:
        while complaint is None and method.time < until - ROUND_OFF * stretch.stops[0]:
            stop.check()
            number += 1
            timed.begin()
            complaint = method.advance(until, number)
            timed.end()
    seconds = comm.bcast((time.perf_counter() - began) * stretch.turnover / max(method.time, 1e-300))
    if complaint is not None:
        log.info("find-step: %s %.4g%s is unstable: %s", step.integrator, step.size, stretch.name, complaint)
        return Trial(stretch, step, seconds)
    particles, _ = method.frame(float(stretch.stops[-1]))
    columns = particles.to_numpy()
    velocity = IdOrder(comm, columns["id"], total).apply(columns["velocity"])
    trial = Trial(stretch, step, seconds, velocity, timed.numbers(comm))
    log.info("find-step: %s %.4g%s: error %.4f, %.3g s per turnover", step.integrator, step.size, stretch.name,
             trial.error, seconds)
    return trial
