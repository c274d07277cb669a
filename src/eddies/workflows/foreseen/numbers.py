"""What a scene amounts to before it is run: its turbulence, and the steps of its direct simulation and its rollout."""

import math
from dataclasses import dataclass

from eddies.clock import ladder_step
from eddies.particles.flow_units import allowed_step, resolved_wavenumber
from eddies.scene.sections import METHODS
from eddies.scene.scene import BOX_LENGTH, Eulerian, Scene

DISSIPATION_CONSTANT = 0.5   # C_eps = eps L / u'^3 of developed turbulence
DECAY_EXPONENT = 1.2         # of the energy of turbulence that nothing forces (Saffman 1967)
PEAK_SPEED = 7.0             # max(|u| + |v| + |w|) over u' in turbulence: four rms in each component at worst


@dataclass(frozen=True)
class ExpectedTurbulence:
    """Turbulence that a scene is expected to develop, from u' and eps; L from eps = C_eps u'^3 / L."""

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

    def decayed(self, time: float) -> float:
        """u' a time after the forcing has ended: the energy E falls as (1 + eps t / (n E))^-n, n = DECAY_EXPONENT."""
        energy = 1.5 * self.velocity_rms**2
        lost = self.dissipation_rate * time / (DECAY_EXPONENT * energy)
        return self.velocity_rms * (1 + lost) ** (-DECAY_EXPONENT / 2)


def largest_wavenumber(scene: Scene) -> int:
    """k_max kept by the 2/3 rule: the largest integer below cells / 3."""
    return (scene.flow.cells - 1) // 3


def expected_turbulence(scene: Scene) -> ExpectedTurbulence | None:
    """Turbulence kept up by the forcing, or decaying from a random start; None of other flows.

    The integral scale is sqrt(2 pi) / k with k of the forcing or of the initial peak, which is exact for the initial
    spectrum and holds within some 10 % for forced turbulence.
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
    """Expected largest |u| + |v| + |w|; None without forcing for a flow from a file or of the user's."""
    initial, turbulence = scene.initial, expected_turbulence(scene)
    if turbulence or initial.flow.turbulent:
        return PEAK_SPEED * (turbulence.velocity_rms if turbulence else initial.amplitude)
    if initial.flow.sound:
        return initial.amplitude * scene.flow.sound_speed
    return initial.flow.peak and initial.flow.peak * initial.amplitude


def rms_speed(scene: Scene) -> float | None:
    """Expected root mean square of the velocity, of all its components; None without forcing for a flow from a file or
    of the user's, and where sound is all that moves."""
    initial, turbulence = scene.initial, expected_turbulence(scene)
    if turbulence:
        return math.sqrt(3) * turbulence.velocity_rms
    return initial.flow.rms and initial.flow.rms * initial.amplitude


def mach(scene: Scene) -> float | None:
    """The expected turbulent Mach number; None without sound."""
    speed = rms_speed(scene)
    return speed / scene.flow.sound_speed if speed is not None and scene.flow.sound_speed else None


# ---- the direct simulation


def explicit_sound(scene: Scene) -> float:
    """sqrt(3) c where the stepper must resolve sound, else 0."""
    return math.sqrt(3) * scene.flow.sound_speed if scene.time.explicit and scene.flow.sound_speed else 0.0


def courant_bound(scene: Scene) -> float | None:
    """The longest step of the direct simulation by its Courant number; None where the speed is not known."""
    speed = peak_speed(scene)
    return None if speed is None else (
        scene.time.courant * BOX_LENGTH / scene.flow.cells / (speed + explicit_sound(scene)))


def expected_step(scene: Scene) -> tuple[float, str] | None:
    """The time step of the direct simulation and what limits it; None where the speed is not known."""
    settings, bound = scene.time, courant_bound(scene)
    if settings.step is not None:
        return settings.step, "fixed by [time] step"
    if bound is None:
        return None
    if bound >= settings.max_step:
        return settings.max_step, "limited by [time] max_step"
    limit = "sound, which rk4 must resolve" if explicit_sound(scene) > peak_speed(scene) else "advection"
    return ladder_step(settings.max_step, bound), f"limited by {limit}: at most {bound:.3g}"


def time_of(scene: Scene, turnovers: float) -> float | None:
    """Physical time of so many turnovers; None where the turnover time is not known."""
    turbulence = expected_turbulence(scene)
    return turbulence and turnovers * turbulence.turnover_time


def run_time(scene: Scene) -> float | None:
    """Physical time that the direct simulation covers; None where the turnover time is not known."""
    parts = [time_of(scene, part.turnovers) for part in (scene.spin_up, scene.tracers) if part]
    return None if None in parts else sum(parts) + (scene.time.duration or 0.0)


def tracer_intervals(scene: Scene) -> int | None:
    """Frame intervals through which tracers are followed, 0 without tracers; None where that is not known."""
    if scene.tracers is None:
        return 0
    span = time_of(scene, scene.tracers.turnovers)
    return span and max(math.ceil(span / scene.tracers.frame_interval - 1e-9), 1)


def flow_steps(scene: Scene) -> int | None:
    """Steps of the direct simulation, with tracers equal ones within each frame interval; None where they are not
    known."""
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
    """A rollout of so many frame intervals: the longest step taken, how many steps, and the evaluations of the
    particles' rates that they need (0 on a coarse grid)."""

    turnover_time: float
    intervals: int
    time_step: float
    steps: int
    evaluations: int


def rollout_of(scene: Scene, turnover_time: float | None = None) -> Rollout | None:
    """The rollout of a scene in a flow of the expected turnover time, or of a given one; None without a rollout, where
    the turnover time is not known, or where what moves the particles is the user's."""
    settings, turbulence = scene.simulation, expected_turbulence(scene)
    if settings is None or settings.method not in METHODS or turbulence is None and turnover_time is None:
        return None
    turnover_time = turnover_time or turbulence.turnover_time
    intervals = math.ceil(settings.turnovers * turnover_time / settings.frame_interval - 1e-9)
    step, interval = rollout_step(scene), settings.frame_interval
    if settings.on_grid or not settings.scheme.dense:  # whole steps between two frames
        within = math.ceil(interval / step - 1e-9)
        step, steps = interval / within, intervals * within
    else:
        steps = math.ceil(intervals * interval / step - 1e-9)
    evaluations = 0 if settings.on_grid else settings.scheme.evaluations * steps + 1
    return Rollout(turnover_time, intervals, step, steps, evaluations)


def rollout_step(scene: Scene) -> float:
    """The time step of the particles: the scene's, or where that is less what their resolved velocity can follow, or
    the Courant number on a coarse grid allows. Where it is still to be found, at most a frame interval is expected."""
    settings, allowed = scene.simulation, None
    if settings.on_grid:
        cells, speed = (scene.eulerian or Eulerian()).cells_for(scene.tracers.filter_width), peak_speed(scene)
        allowed = speed and scene.time.courant * BOX_LENGTH / cells / speed
    elif "model" in settings.needs and scene.resolves:
        allowed = expected_allowed_step(scene)
    return min(settings.longest_step if math.isfinite(settings.longest_step) else settings.frame_interval,
               allowed or math.inf)


def resolved_shells(scene: Scene) -> int:
    """Highest wavenumber, along each axis, of the velocity that the particles resolve."""
    tracers, turbulence = scene.tracers, expected_turbulence(scene)
    highest = resolved_wavenumber(tracers.spacing, tracers.filter_width,
                                  turbulence.kolmogorov_length if turbulence else 0.0)
    return min(max(int(highest + 1e-9), 1), (tracers.planes - 1) // 2)


def expected_allowed_step(scene: Scene) -> float | None:
    """The longest time step that particles with a resolved velocity can take in the expected turbulence, in the middle
    of their rollout where it decays; None where it is not known."""
    settings, turbulence = scene.simulation, expected_turbulence(scene)
    if turbulence is None:
        return None
    speed = turbulence.velocity_rms
    if not scene.injects:
        start = scene.seen_in(scene.directory) if settings.start is None else settings.start
        turnovers = start * scene.tracers.turnovers + settings.turnovers / 2
        speed = turbulence.decayed(turnovers * turbulence.turnover_time)
    return allowed_step(settings.scheme.angle, resolved_shells(scene), speed)
