"""What keeps the stages of a scene from their end, as far as the scene, the machine and the run directory tell before
any work: told then, not hours later."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from eddies.io.hdf5 import open_product
from eddies.io.trajectories import Trajectory
from eddies.parallel.broadcast import on_first_rank
from eddies.parallel.communicator import Comm
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.flow_units import ScaleError
from eddies.pipeline import STAGES
from eddies.scene.scene import BOX_LENGTH, Scene, SceneError, Tracers
from eddies.workflows.foreseen.numbers import expected_step, expected_turbulence, run_time
from eddies.workflows.ground_truth.frame_counts import check_frames

# Of the direct simulation, of the rollout, and frames of the tracers: at a microsecond each a quarter of an hour, and
# no step of a flow takes so little.
MOST_STEPS = 10**9
# The turnover time at the release of tracers over the one that is foreseen, at most: the flow may have decayed.
LATER = 3.0
# Re_lambda from which on the turnover time of a forced flow is as foreseen, but for that factor.
TURBULENT = 20.0
# Logarithm of the share of the energy below which nothing is left of a flow but round-off.
SILENCE = -40.0
# How many times the energy of a flow the forcing may put in in one step.
MOST_FORCED = 50


def check_feasible(stages: Sequence[str], scene: Scene, comm: Comm, directory: Path | None = None) -> None:
    """Refuse stages of a scene that cannot come to their end in a directory, or in runs/NAME; all ranks call it.

    Raises SceneError for what the scene tells, DeviceError where there is no GPU for one that asks for it.
    """
    problem = next(problems(stages, scene, scene.seen_in(directory or scene.directory)), None)
    if problem is not None:
        raise SceneError(f"{scene.name}: {problem}")
    if scene.device != "cpu" and {"train", "simulate"} & set(stages):
        from eddies.particles.devices import prepare_torch  # torch, only here
        prepare_torch(scene.device, comm)


def check_ground_truth(stages: Sequence[str], scene: Scene, comm: Comm, directory: Path) -> None:
    """Refuse a ground truth that one of these stages cannot work with: of too few frames, or of a flow whose scales
    vanish; all ranks call it."""
    path = directory / STAGES["dns"].file
    with open_product(comm, path, "ground_truth") as file:
        check_frames(stages, scene, scene.seen_in(directory), len(Trajectory(file, "tracers").times))
        if {"train", "simulate"} & set(stages):
            from eddies.workflows.ground_truth.truth import GroundTruth  # torch, only here
            truth = GroundTruth(file, SlabDecomposition(comm, BOX_LENGTH, scene.tracers.planes))
            try:
                truth.scales
            except ScaleError as error:
                raise SceneError(f"{path}: {error}") from None
            turnover = truth.reference["eddy_turnover_time"]
            for problem in rollout_problems(scene, turnover) if "simulate" in stages else ():
                raise SceneError(f"{scene.name}: {problem}")


def check_places(stages: Sequence[str], comm: Comm, directory: Path) -> None:
    """Refuse a run directory that cannot be one, or in which something else stands where a stage writes."""
    def look() -> None:
        if directory.is_dir() and not os.access(directory, os.W_OK | os.X_OK):
            raise SceneError(f"{directory}: cannot be written; change its permissions, or choose another directory")
        for stage in [STAGES[name] for name in stages]:
            file, folder = (stage.file, stage.checkpoints) if stage.product is not None else (None, "report")
            if file is not None and (directory / file).is_dir():
                raise SceneError(f"{directory / file}: is a directory, and `eddies {stage.name}` writes a file of this "
                                 "name; move it away, or choose another directory")
            if folder is not None and (directory / folder).exists() and not (directory / folder).is_dir():
                raise SceneError(f"{directory / folder}: is a file, and `eddies {stage.name}` makes a directory of "
                                 "this name; move it away, or choose another directory")

    try:
        on_first_rank(comm, look)
    except OSError as error:
        raise SceneError(f"{directory}: cannot be used ({error.strerror}); choose another --output") from None


def problems(stages: Sequence[str], scene: Scene, seen: float) -> Iterator[str]:
    """What cannot come to its end, in words, where the model is trained on a fraction `seen` of the ground truth."""
    if "dns" in stages:
        yield from forcing_problems(scene)
        yield from decay_problems(scene)
        yield from step_problems(scene)
    if "simulate" in stages:
        yield from rollout_problems(scene)
    if "dns" in stages and scene.tracers is not None:
        yield from frame_problems(stages, scene, seen)


def forcing_problems(scene: Scene) -> Iterator[str]:
    """A start so weak that one step of the forcing multiplies it: its power is prescribed."""
    forcing, initial = scene.forcing, scene.initial
    if forcing is None or initial.flow.rms is None:
        return
    step = scene.time.step or scene.time.max_step  # the weaker the flow, the longer its step
    unit = initial.flow.rms**2 / 2  # energy over the square of the amplitude
    energy, gained = unit * initial.amplitude**2, forcing.injection_rate * step
    if gained > MOST_FORCED * energy:
        least = math.sqrt(gained / MOST_FORCED / unit)
        yield (f"[initial] amplitude = {initial.amplitude:g}: an energy of {energy:.2g}, of which [forcing] "
               f"injection_rate = {forcing.injection_rate:g} makes {gained:.2g} in one step of {step:g}, which is "
               f"unstable; raise amplitude to {least:.2g} or more, or lower injection_rate or [time] max_step")


def decay_problems(scene: Scene) -> Iterator[str]:
    """A flow of which viscosity leaves nothing while the tracers follow it."""
    turbulence = expected_turbulence(scene)
    if scene.tracers is None or turbulence is None or scene.tracers.forced:
        return
    time = scene.tracers.turnovers * turbulence.turnover_time
    exponent = -2 * scene.flow.viscosity * time  # of the largest modes, |k| = 1
    if exponent < SILENCE:
        yield (f"[flow] viscosity = {scene.flow.viscosity:g}: Re_lambda would be {turbulence.reynolds_lambda:.1g}, and "
               f"of the flow's energy less than exp({exponent:.3g}) would be left after [tracers] turnovers = "
               f"{scene.tracers.turnovers:g}, a time of {time:.3g}; lower viscosity or turnovers")


def step_problems(scene: Scene) -> Iterator[str]:
    """More steps of the direct simulation, or frames, than any run can take."""
    expected, span = expected_step(scene), run_time(scene)
    if expected is not None and span is not None:
        yield from too_many_steps(scene, span, *expected)
    turbulence, tracers = expected_turbulence(scene), scene.tracers
    if tracers is not None and turbulence is not None:
        yield from too_many_frames(tracers, tracers.turnovers * turbulence.turnover_time)


def too_many_steps(scene: Scene, span: float, step: float, limit: str) -> Iterator[str]:
    """More steps of the direct simulation than MOST_STEPS in a time; `limit` is what limits the step, in words."""
    if not span <= MOST_STEPS * step:  # so that what is no number is refused
        yield (f"the direct simulation would take {span / step:.1e} steps of {step:.3g}, {limit}, for a time of "
               f"{span:.3g}, and {MOST_STEPS:.0e} are the most; raise {_step_key(scene, limit)} or shorten "
               f"{'[time] duration' if scene.tracers is None else '[tracers] or [spin_up] turnovers'}")


def too_many_frames(tracers: Tracers, span: float) -> Iterator[str]:
    """More frames of tracers than MOST_STEPS in a time."""
    if not span <= MOST_STEPS * tracers.frame_interval:
        yield (f"[tracers] frame_interval = {tracers.frame_interval:g}: {span / tracers.frame_interval:.1e} frames "
               f"in {tracers.turnovers:g} turnovers, and {MOST_STEPS:.0e} are the most; raise frame_interval")


def check_span(scene: Scene, span: float, bound: float, frames: bool = False) -> None:
    """Raise SceneError where the flow as it is takes too many steps for a time, or with `frames` stores too many in it,
    or where the time is without end, as in a flow at rest.

    For flows that are not known before they are there; `bound` is the longest step that this one allows.
    """
    if span == math.inf:
        raise SceneError(f"{scene.name}: the flow is at rest, so that it never turns over; start from another one")
    settings = scene.time
    step = settings.step or min(bound, settings.max_step)
    limit = ("fixed by [time] step" if settings.step else
             "limited by [time] max_step" if bound >= settings.max_step else "limited by the flow")
    problems = [*too_many_steps(scene, span, step, limit), *(too_many_frames(scene.tracers, span) if frames else ())]
    if problems:
        raise SceneError(f"{scene.name}: {problems[0]}")


def _step_key(scene: Scene, limit: str) -> str:
    if scene.time.step is not None:
        return "[time] step"
    return "[time] max_step" if "max_step" in limit else "[time] courant, lower [flow] cells or the speed of the flow,"


def rollout_problems(scene: Scene, turnover_time: float | None = None) -> Iterator[str]:
    """More steps of a rollout than it can take, in a flow of the expected turnover time or of a given one."""
    settings, turbulence = scene.simulation, expected_turbulence(scene)
    span = settings.frame_interval  # at the least
    if turnover_time is None and turbulence is not None:
        turnover_time = turbulence.turnover_time
    if turnover_time is not None:
        span = max(span, settings.turnovers * turnover_time)
    if span > MOST_STEPS * settings.longest_step:
        yield (f"[simulation] step = {settings.step:g}: {span / settings.longest_step:.1e} steps for a time of "
               f"{span:.3g}, and {MOST_STEPS:.0e} are the most; raise step or lower turnovers")


def frame_problems(stages: Sequence[str], scene: Scene, seen: float) -> Iterator[str]:
    """Too few frames of the ground truth for the other stages, even if the flow turns over as slowly as it may.

    Not of a flow that decays before the tracers start, or that is hardly turbulent, whose turnover time may be any.
    """
    turbulence, turnovers = expected_turbulence(scene), scene.tracers.turnovers
    decays = scene.spin_up is not None and scene.forcing is None
    if turbulence is None or decays or turbulence.reynolds_lambda < TURBULENT:
        return
    longest = LATER * turnovers * turbulence.turnover_time
    frames = max(math.ceil(longest / scene.tracers.frame_interval), 1) + 1
    try:
        check_frames(stages, scene, seen, frames)
    except SceneError as error:
        yield f"with at most {frames} frames, as is foreseen of [tracers] turnovers = {turnovers:g}: {error}"
