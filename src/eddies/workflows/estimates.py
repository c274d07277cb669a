"""Estimates of a scene before it runs: its turbulence, and the steps and frames of its direct simulation."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from eddies.clock import Clock, ladder_step
from eddies.errors import UserError
from eddies.flow.history import FlowHistory
from eddies.flow.initial_fields import SPEEDS
from eddies.flow.navier_stokes import advective_speed
from eddies.flow.statistics import derived_scales
from eddies.parallel.communicator import Comm
from eddies.parallel.reduction import global_max
from eddies.scene.scene import BOX_LENGTH, Flow, Forcing, Initial, Scene
from eddies.workflows.ground_truth.scene_flow import build_fluid, initial_state

DISSIPATION_CONSTANT = 0.5   # C_eps = eps L / u'^3 of developed turbulence
PEAK_SPEED = 7.0             # max(|u| + |v| + |w|) divided by u' in turbulence; one component is at most about 4 u'

#: What the files of scenes hold, by [flow] and [initial]: scales of an initial flow and its `peak_speed`, or tracks.
Measured = Mapping[tuple[Flow, Initial], Any]


@dataclass(frozen=True)
class MeasuredTracks:
    """The tracks in the file of [tracks]: their mean number in a frame, the number of tracks in all frames, and the
    number of frames."""

    in_frame: float
    complete: int
    frames: int


def measure(scenes: Iterable[Scene], comm: Comm) -> tuple[Measured, list[str]]:
    """Read the files from which the flows or tracks of scenes come; all ranks call it.

    Returns what they hold, and a message for each file that cannot be used. An initial flow is made on the grid of the
    scene, as at the start of the direct simulation.
    """
    found: dict[tuple[Flow, Initial], Any] = {}
    problems = []
    for key, scene in {(each.flow, each.initial): each for each in scenes}.items():
        try:
            if scene.tracks is not None:
                from eddies.workflows.ground_truth.track_frames import TrackFrames  # imports scipy
                tracks = TrackFrames(comm, scene.tracks)
                found[key] = MeasuredTracks(tracks.mean_count, tracks.complete, len(tracks.times))
            elif scene.initial.path is not None:
                fluid = build_fluid(scene.flow, None, comm)
                state = initial_state(scene.initial, scene.seed, fluid)
                speed = float(global_max(comm, advective_speed(fluid.grid, state[:3])))
                found[key] = FlowHistory(fluid).sample(state, Clock()) | {"peak_speed": speed}
        except UserError as error:
            problems.append(str(error))
    return found, problems


# ---- turbulence and steps


@dataclass(frozen=True, kw_only=True)
class Estimates:
    """Expected numbers of a scene; None where they are unknown before a run.

    Parameters
    ----------
    scales : scales of the turbulence that the forcing sustains, or of the initial flow, with the names that they have
        in `reference` of a ground truth; None for a flow without turbulence.
    peak_speed : maximum of |u| + |v| + |w|; None if the flow comes from the user and is not forced.
    rms_speed : rms of the velocity vector; None where `peak_speed` is None, and for a pure sound wave.
    mach : turbulent Mach number; None for a fluid without a sound speed.
    courant_step : longest step of the direct simulation that its Courant number allows.
    step, limited_by : time step of the direct simulation, and the key of [time] that limits it.
    run_time : physical time that the direct simulation covers.
    frames : number of frames of the tracers or tracks, 0 without them.
    steps : number of steps of the direct simulation.
    tracks : the measured tracks.
    """

    scales: Mapping[str, float] | None
    peak_speed: float | None
    rms_speed: float | None
    mach: float | None
    courant_step: float | None
    step: float | None
    limited_by: str
    run_time: float | None
    frames: int | None
    steps: int | None
    tracks: MeasuredTracks | None


def estimate(scene: Scene, measured: Measured = {}) -> Estimates:
    """Estimate the turbulence, the speeds and the steps of a scene. `measured` is what `measure` has found."""
    flow, time, tracers, known = scene.flow, scene.time, scene.tracers, measured.get((scene.flow, scene.initial))
    tracks = known if scene.tracks is not None else None
    scales, peak, rms = (None, None, None) if scene.tracks is not None else _speeds(scene, known)
    bound = step = None
    if peak is not None:  # sound counts for an explicit stepper only
        speed = peak + (math.sqrt(3) * (flow.sound_speed or 0.0) if time.explicit else 0.0)
        bound = time.courant * BOX_LENGTH / flow.cells / speed if speed > 0 else math.inf
        step, limited_by = ladder_step(time.max_step, bound), "max_step" if bound >= time.max_step else "courant"
    if time.step is not None or bound is None:
        step, limited_by = time.step, "step"
    spin_up, followed = (0.0 if part is None else part.turnovers * scales["eddy_turnover_time"] if scales else None
                         for part in (scene.spin_up, tracers))
    frames = run_time = steps = None
    if scene.tracks is not None:
        frames = tracks and tracks.frames
    elif followed is not None:
        frames = max(rounded_up(followed / tracers.frame_interval), 1) + 1 if tracers else 0
    if spin_up is not None and followed is not None:
        alone = spin_up + (time.duration or 0.0)
        run_time = alone + followed
        if step is not None:
            steps = rounded_up(alone / step)
            if tracers:  # each frame interval is divided into equal steps
                longest = min(time.step or bound, time.max_step)
                steps += (frames - 1) * rounded_up(tracers.frame_interval / longest)
    return Estimates(
        scales=scales, peak_speed=peak, rms_speed=rms,
        mach=rms / flow.sound_speed if rms is not None and flow.sound_speed else None, courant_step=bound, step=step,
        limited_by=limited_by, run_time=run_time, frames=frames, steps=steps, tracks=tracks)


def _speeds(scene: Scene, known: Mapping[str, float] | None) -> tuple[
        Mapping[str, float] | None, float | None, float | None]:
    """Return `scales`, `peak_speed` and `rms_speed` of the estimates. `known` holds the scales of the initial flow in a
    file."""
    initial, forcing = scene.initial, scene.forcing
    if known is not None and not (scene.spin_up and forcing and forcing.injection_rate > 0):
        return (known if known["dissipation_rate"] > 0 else None, known["peak_speed"],
                math.sqrt(3) * known["velocity_rms"])
    scales = expected_scales(scene.flow, initial, forcing)
    if scales or initial.flow.turbulent:
        speed = scales["velocity_rms"] if scales else initial.amplitude
        return scales, PEAK_SPEED * speed, math.sqrt(3) * speed
    if initial.flow.sound:
        return None, initial.amplitude * scene.flow.sound_speed, None
    rms, peak = (each and each * initial.amplitude for each in SPEEDS.get(initial.kind, (None, None)))
    return None, peak, rms


def expected_scales(flow: Flow, initial: Initial, forcing: Forcing | None) -> dict[str, float] | None:
    """Return the scales of the turbulence that the forcing sustains, or that decays from a random start; None for other
    flows.

    The integral scale is sqrt(2 pi) / k, where k is the wavenumber of the forcing or the initial peak of the spectrum.
    This is exact for the initial spectrum and holds within about 10 % for forced turbulence. The dissipation rate is
    C_eps u'^3 / L.
    """
    if forcing and forcing.injection_rate > 0:
        scale, rate = math.sqrt(2 * math.pi) / forcing.wavenumber, forcing.injection_rate
        speed = (rate * scale / DISSIPATION_CONSTANT) ** (1 / 3)
    elif initial.flow.turbulent:
        scale, speed = math.sqrt(2 * math.pi) / initial.peak_wavenumber, initial.amplitude
        rate = DISSIPATION_CONSTANT * speed**3 / scale
    else:
        return None
    found = {"dissipation_rate": rate, **derived_scales(speed, scale, rate, flow.viscosity, flow.largest_wavenumber)}
    return found if flow.viscosity > 0 else None


def rounded_up(ratio: float) -> int:
    """Round up to a whole number, but ignore an excess of the order of round-off."""
    return math.ceil(ratio - 1e-9)
