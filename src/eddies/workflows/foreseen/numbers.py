"""Estimates of a scene before it runs: its turbulence, and the steps of its direct simulation and of its rollout."""

import math
from dataclasses import dataclass

from eddies.clock import ladder_step
from eddies.particles.flow_units import allowed_step, resolved_wavenumber
from eddies.scene.scene import BOX_LENGTH, Flow, Forcing, Initial, Scene, Simulation, Time
from eddies.scene.sections import METHODS

DISSIPATION_CONSTANT = 0.5   # C_eps = eps L / u'^3 of developed turbulence
PEAK_SPEED = 7.0             # max(|u| + |v| + |w|) divided by u' in turbulence; one component is at most about 4 u'


@dataclass(frozen=True)
class Turbulence:
    """Expected turbulence of a scene, from u', eps and nu. u' is the rms of one velocity component. The integral scale
    L follows from eps = C_eps u'^3 / L."""

    velocity_rms: float
    dissipation_rate: float
    viscosity: float

    @property
    def turnover_time(self) -> float:
        """Eddy turnover time T = L / u'."""
        return DISSIPATION_CONSTANT * self.velocity_rms**2 / self.dissipation_rate

    @property
    def kolmogorov_length(self) -> float:
        """Kolmogorov length eta = (nu^3 / eps)^(1/4)."""
        return (self.viscosity**3 / self.dissipation_rate) ** 0.25

    @property
    def kolmogorov_time(self) -> float:
        """Kolmogorov time t_eta = (nu / eps)^(1/2)."""
        return math.sqrt(self.viscosity / self.dissipation_rate)

    @property
    def reynolds_lambda(self) -> float:
        """Reynolds number Re_lambda = u' lambda / nu with lambda = (15 nu u'^2 / eps)^(1/2)."""
        return self.velocity_rms**2 * math.sqrt(15 / (self.viscosity * self.dissipation_rate))


@dataclass(frozen=True)
class Rollout:
    """Expected numbers of a rollout: turnover time of the flow, number of frame intervals, time step, number of steps,
    and number of evaluations of the particles' rates (0 on a coarse grid)."""

    turnover_time: float
    intervals: int
    time_step: float
    steps: int
    evaluations: int


@dataclass(frozen=True, kw_only=True)
class Estimates:
    """Expected numbers of a scene; None where they are unknown before a run.

    Parameters
    ----------
    turbulence : sustained by the forcing, or decaying from a random start; None for other flows.
    peak_speed : maximum of |u| + |v| + |w|; None if the flow comes from a file or from the user and is not forced.
    rms_speed : rms of the velocity vector; None where `peak_speed` is None, and for a pure sound wave.
    mach : turbulent Mach number; None for a fluid without a sound speed.
    courant_step : longest step of the direct simulation that its Courant number allows.
    step, limited_by : time step of the direct simulation, and the key of [time] that limits it.
    run_time : physical time that the direct simulation covers.
    frame_intervals : number of frame intervals of the tracers, 0 without tracers.
    steps : number of steps of the direct simulation.
    resolved_shells : largest wavenumber along each axis of the resolved velocity of particles; 0 without tracers.
    allowed_step : longest step with which particles follow their resolved velocity, at the expected rms velocity.
    rollout_step : longest step of the rollout.
    rollout : numbers of the rollout; None also if the scene has no rollout, and for a method of the user.
    """

    turbulence: Turbulence | None
    peak_speed: float | None
    rms_speed: float | None
    mach: float | None
    courant_step: float | None
    step: float | None
    limited_by: str
    run_time: float | None
    frame_intervals: int | None
    steps: int | None
    resolved_shells: int
    allowed_step: float | None
    rollout_step: float
    rollout: Rollout | None


def estimate(scene: Scene) -> Estimates:
    """Estimate the turbulence, the speeds and the steps of a scene."""
    initial, time, tracers, settings = scene.initial, scene.time, scene.tracers, scene.simulation
    turbulence = None if scene.tracks else expected_turbulence(scene.flow, initial, scene.forcing)
    peak = rms = None
    if scene.tracks is None:
        peak, rms = peak_speed(scene.flow, initial, turbulence), rms_speed(initial, turbulence)
    bound = courant_step(scene.flow, time, peak)
    step, limited_by = flow_step(time, bound)
    spin_up, followed = (0.0 if part is None else part.turnovers * turbulence.turnover_time if turbulence else None
                         for part in (scene.spin_up, tracers))
    intervals: int | None = 0
    if tracers:
        intervals = None if followed is None else max(_rounded_up(followed / tracers.frame_interval), 1)
    run_time = steps = None
    if spin_up is not None and followed is not None:
        alone = spin_up + (time.duration or 0.0)
        run_time = alone + followed
        if step is not None:
            longest = min(time.step or bound, time.max_step)
            steps = _rounded_up(alone / step)
            if tracers:  # each frame interval is divided into equal steps
                steps += intervals * _rounded_up(tracers.frame_interval / longest)
    shells, allowed, rollout_step, rollout = 0, None, math.inf, None
    if tracers:
        highest = resolved_wavenumber(tracers.spacing, tracers.filter_width,
                                      turbulence.kolmogorov_length if turbulence else 0.0)
        shells = min(max(int(highest + 1e-9), 1), (tracers.planes - 1) // 2)
    if settings is not None:
        if turbulence is not None:
            allowed = allowed_step(settings.scheme.angle, shells, turbulence.velocity_rms)
        # A step that must still be found is assumed to be one frame interval, or less if a limit applies.
        rollout_step = settings.frame_interval if math.isinf(settings.longest_step) else settings.longest_step
        if scene.coarse_cells and peak:
            rollout_step = min(rollout_step, time.courant * BOX_LENGTH / scene.coarse_cells / peak)
        elif "model" in settings.needs and scene.needs_resolved_velocity:
            rollout_step = min(rollout_step, allowed or math.inf)
        if turbulence is not None and settings.method in METHODS:
            rollout = rollout_in(settings, turbulence.turnover_time, rollout_step)
    return Estimates(
        turbulence=turbulence, peak_speed=peak, rms_speed=rms,
        mach=rms / scene.flow.sound_speed if rms is not None and scene.flow.sound_speed else None, courant_step=bound,
        step=step, limited_by=limited_by, run_time=run_time, frame_intervals=intervals, steps=steps,
        resolved_shells=shells, allowed_step=allowed, rollout_step=rollout_step, rollout=rollout)


def expected_turbulence(flow: Flow, initial: Initial, forcing: Forcing | None) -> Turbulence | None:
    """Return the turbulence that the forcing sustains, or that decays from a random start; None for other flows.

    The integral scale is sqrt(2 pi) / k, where k is the wavenumber of the forcing or the initial peak of the spectrum.
    This is exact for the initial spectrum and holds within about 10 % for forced turbulence.
    """
    if flow.viscosity == 0:
        return None
    if forcing and forcing.injection_rate > 0:
        scale = math.sqrt(2 * math.pi) / forcing.wavenumber
        speed = (forcing.injection_rate * scale / DISSIPATION_CONSTANT) ** (1 / 3)
        return Turbulence(speed, forcing.injection_rate, flow.viscosity)
    if initial.flow.turbulent:
        scale = math.sqrt(2 * math.pi) / initial.peak_wavenumber
        return Turbulence(initial.amplitude, DISSIPATION_CONSTANT * initial.amplitude**3 / scale, flow.viscosity)
    return None


def peak_speed(flow: Flow, initial: Initial, turbulence: Turbulence | None) -> float | None:
    """Return the expected maximum of |u| + |v| + |w|; None if the flow comes from a file or from the user and is not
    forced."""
    if turbulence or initial.flow.turbulent:
        return PEAK_SPEED * (turbulence.velocity_rms if turbulence else initial.amplitude)
    if initial.flow.sound:
        return initial.amplitude * flow.sound_speed
    return initial.flow.peak and initial.flow.peak * initial.amplitude


def rms_speed(initial: Initial, turbulence: Turbulence | None) -> float | None:
    """Return the expected rms of the velocity vector; None where it is unknown, and for a pure sound wave."""
    if turbulence:
        return math.sqrt(3) * turbulence.velocity_rms
    return initial.flow.rms and initial.flow.rms * initial.amplitude


def courant_step(flow: Flow, time: Time, speed: float | None) -> float | None:
    """Return the longest step that the Courant number allows. `speed` is the maximum of |u| + |v| + |w|. For an
    explicit stepper the speed of sound counts, too."""
    sound = flow.sound_speed if time.explicit else None
    return None if speed is None else time.courant * BOX_LENGTH / flow.cells / (speed + math.sqrt(3) * (sound or 0.0))


def flow_step(time: Time, bound: float | None) -> tuple[float | None, str]:
    """Return the time step of the direct simulation, and the key of [time] that limits it. `bound` is the longest step
    that the Courant number allows."""
    if time.step is not None:
        return time.step, "step"
    if bound is None:
        return None, ""
    return ladder_step(time.max_step, bound), "max_step" if bound >= time.max_step else "courant"


def rollout_in(settings: Simulation, turnover_time: float, longest: float) -> Rollout:
    """Return the expected numbers of a rollout in a flow with this turnover time. No step is longer than `longest`."""
    interval = settings.frame_interval
    intervals, step = _rounded_up(settings.turnovers * turnover_time / interval), longest
    if settings.on_grid or not settings.scheme.dense:  # a whole number of steps between two frames
        within = _rounded_up(interval / longest)
        step, steps = interval / within, intervals * within
    else:
        steps = _rounded_up(intervals * interval / longest)
    return Rollout(turnover_time, intervals, step, steps,
                   0 if settings.on_grid else settings.scheme.evaluations * steps + 1)


def _rounded_up(ratio: float) -> int:
    """Round up to a whole number, but ignore an excess of the order of round-off."""
    return math.ceil(ratio - 1e-9)
