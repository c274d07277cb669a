"""Estimates of a scene before it runs: its turbulence, and the steps of its direct simulation and of its rollout."""

import math
from dataclasses import dataclass

from eddies.clock import ladder_step
from eddies.particles.flow_units import allowed_step, resolved_wavenumber
from eddies.scene.sections import METHODS
from eddies.scene.scene import BOX_LENGTH, Eulerian, Scene

DISSIPATION_CONSTANT = 0.5   # C_eps = eps L / u'^3 of developed turbulence
PEAK_SPEED = 7.0             # max(|u| + |v| + |w|) over u' in turbulence: at most four rms in each component


@dataclass(frozen=True)
class ExpectedTurbulence:
    """Expected turbulence of a scene, from u', eps and nu; the integral scale follows from eps = C_eps u'^3 / L."""

    velocity_rms: float
    dissipation_rate: float
    viscosity: float

    @property
    def turnover_time(self) -> float:
        """T = L / u'."""
        return DISSIPATION_CONSTANT * self.velocity_rms**2 / self.dissipation_rate

    @property
    def kolmogorov_length(self) -> float:
        """eta = (nu^3 / eps)^(1/4)."""
        return (self.viscosity**3 / self.dissipation_rate) ** 0.25

    @property
    def kolmogorov_time(self) -> float:
        """t_eta = (nu / eps)^(1/2)."""
        return math.sqrt(self.viscosity / self.dissipation_rate)

    @property
    def reynolds_lambda(self) -> float:
        """Re_lambda = u' lambda / nu with lambda = (15 nu u'^2 / eps)^(1/2)."""
        return self.velocity_rms**2 * math.sqrt(15 / (self.viscosity * self.dissipation_rate))


def largest_wavenumber(scene: Scene) -> int:
    """k_max of the 2/3 rule: the largest integer below cells / 3."""
    return (scene.flow.cells - 1) // 3


def expected_turbulence(scene: Scene) -> ExpectedTurbulence | None:
    """Turbulence that the forcing sustains, or that decays from a random start; None for other flows.

    The integral scale is sqrt(2 pi) / k, with k of the forcing or of the initial peak. This is exact for the initial
    spectrum and holds within about 10 % for forced turbulence.
    """
    forcing, initial, viscosity = scene.forcing, scene.initial, scene.flow.viscosity
    if viscosity == 0:
        return None
    if forcing and forcing.injection_rate > 0:
        scale = math.sqrt(2 * math.pi) / forcing.wavenumber
        speed = (forcing.injection_rate * scale / DISSIPATION_CONSTANT) ** (1 / 3)
        return ExpectedTurbulence(speed, forcing.injection_rate, viscosity)
    if initial.flow.turbulent:
        scale = math.sqrt(2 * math.pi) / initial.peak_wavenumber
        return ExpectedTurbulence(initial.amplitude, DISSIPATION_CONSTANT * initial.amplitude**3 / scale, viscosity)
    return None


def peak_speed(scene: Scene) -> float | None:
    """Expected maximum of |u| + |v| + |w|; None for a flow from a file or of the user's without forcing."""
    initial, turbulence = scene.initial, expected_turbulence(scene)
    if turbulence or initial.flow.turbulent:
        return PEAK_SPEED * (turbulence.velocity_rms if turbulence else initial.amplitude)
    if initial.flow.sound:
        return initial.amplitude * scene.flow.sound_speed
    return initial.flow.peak and initial.flow.peak * initial.amplitude


def rms_speed(scene: Scene) -> float | None:
    """Expected rms of the velocity vector; None where `peak_speed` is None, and for a pure sound wave."""
    initial, turbulence = scene.initial, expected_turbulence(scene)
    if turbulence:
        return math.sqrt(3) * turbulence.velocity_rms
    return initial.flow.rms and initial.flow.rms * initial.amplitude


def mach(scene: Scene) -> float | None:
    """Expected turbulent Mach number; None without sound."""
    speed = rms_speed(scene)
    return speed / scene.flow.sound_speed if speed is not None and scene.flow.sound_speed else None


# ---- the direct simulation


def courant_bound(scene: Scene) -> float | None:
    """Longest step that the Courant number allows; None where the speed is unknown. An explicit stepper resolves
    sound."""
    speed, sound = peak_speed(scene), scene.flow.sound_speed if scene.time.explicit else None
    return None if speed is None else (
        scene.time.courant * BOX_LENGTH / scene.flow.cells / (speed + math.sqrt(3) * (sound or 0.0)))


def expected_step(scene: Scene) -> tuple[float, str] | None:
    """Time step of the direct simulation and the key of [time] that limits it; None where the speed is unknown."""
    settings, bound = scene.time, courant_bound(scene)
    if settings.step is not None:
        return settings.step, "step"
    if bound is None:
        return None
    return ladder_step(settings.max_step, bound), "max_step" if bound >= settings.max_step else "courant"


def time_of(scene: Scene, turnovers: float) -> float | None:
    """Physical time of a number of turnovers; None where the turnover time is unknown."""
    turbulence = expected_turbulence(scene)
    return turbulence and turnovers * turbulence.turnover_time


def run_time(scene: Scene) -> float | None:
    """Physical time that the direct simulation covers; None where the turnover time is unknown."""
    parts = [time_of(scene, part.turnovers) for part in (scene.spin_up, scene.tracers) if part]
    return None if None in parts else sum(parts) + (scene.time.duration or 0.0)


def tracer_intervals(scene: Scene) -> int | None:
    """Number of frame intervals of the tracers, 0 without tracers; None where the turnover time is unknown."""
    if scene.tracers is None:
        return 0
    span = time_of(scene, scene.tracers.turnovers)
    return span and max(math.ceil(span / scene.tracers.frame_interval - 1e-9), 1)


def flow_steps(scene: Scene) -> int | None:
    """Number of steps of the direct simulation; None where it is unknown. With tracers, each frame interval is divided
    into equal steps."""
    expected, span, intervals = expected_step(scene), run_time(scene), tracer_intervals(scene)
    if expected is None or not span:
        return None
    alone = time_of(scene, scene.spin_up.turnovers) if scene.spin_up else 0.0
    steps = math.ceil((alone + (scene.time.duration or 0.0)) / expected[0] - 1e-9)
    if not intervals:
        return steps
    longest = min(scene.time.step or courant_bound(scene), scene.time.max_step)
    return steps + intervals * math.ceil(scene.tracers.frame_interval / longest - 1e-9)


# ---- the rollout


@dataclass(frozen=True)
class Rollout:
    """Number of frame intervals of a rollout, its longest step, its number of steps, and how often it evaluates the
    rates of the particles (0 on a coarse grid)."""

    turnover_time: float
    intervals: int
    time_step: float
    steps: int
    evaluations: int


def rollout_of(scene: Scene, turnover_time: float | None = None) -> Rollout | None:
    """Rollout of a scene in a flow of the expected turnover time, or of a given one.

    Returns None without a rollout, where the turnover time is unknown, and for a method of the user's.
    """
    settings, turbulence = scene.simulation, expected_turbulence(scene)
    if settings is None or settings.method not in METHODS or turbulence is None and turnover_time is None:
        return None
    turnover_time = turnover_time or turbulence.turnover_time
    intervals = math.ceil(settings.turnovers * turnover_time / settings.frame_interval - 1e-9)
    step, interval = rollout_step(scene), settings.frame_interval
    if settings.on_grid or not settings.scheme.dense:  # a whole number of steps between two frames
        within = math.ceil(interval / step - 1e-9)
        step, steps = interval / within, intervals * within
    else:
        steps = math.ceil(intervals * interval / step - 1e-9)
    evaluations = 0 if settings.on_grid else settings.scheme.evaluations * steps + 1
    return Rollout(turnover_time, intervals, step, steps, evaluations)


def rollout_step(scene: Scene) -> float:
    """Time step of the particles: the scene's, unless the resolved velocity or the Courant number of a coarse grid
    demands a shorter one. A step that is still to be found counts as one frame interval at most."""
    settings, allowed = scene.simulation, None
    if settings.on_grid:
        cells, speed = (scene.eulerian or Eulerian()).cells_for(scene.tracers.filter_width), peak_speed(scene)
        allowed = speed and scene.time.courant * BOX_LENGTH / cells / speed
    elif "model" in settings.needs and scene.resolves:
        allowed = expected_allowed_step(scene)
    return min(settings.longest_step if math.isfinite(settings.longest_step) else settings.frame_interval,
               allowed or math.inf)


def resolved_shells(scene: Scene) -> int:
    """Largest wavenumber along each axis of the resolved velocity of the particles."""
    tracers, turbulence = scene.tracers, expected_turbulence(scene)
    highest = resolved_wavenumber(tracers.spacing, tracers.filter_width,
                                  turbulence.kolmogorov_length if turbulence else 0.0)
    return min(max(int(highest + 1e-9), 1), (tracers.planes - 1) // 2)


def expected_allowed_step(scene: Scene) -> float | None:
    """Longest time step of particles with a resolved velocity, at the speed at which the tracers start; None where that
    is unknown."""
    turbulence = expected_turbulence(scene)
    return turbulence and allowed_step(scene.simulation.scheme.angle, resolved_shells(scene), turbulence.velocity_rms)
