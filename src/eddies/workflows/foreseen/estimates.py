"""What to expect of a scene before it is run: turbulence, time steps, and the ranks that it can use."""

import math
from dataclasses import dataclass, replace

from eddies.clock import ladder_step
from eddies.io.provenance import product_attributes
from eddies.particles.flow_units import allowed_step, resolved_wavenumber
from eddies.scene.rules import quoted
from eddies.scene.scene import BOX_LENGTH, Eulerian, Scene, Tracers

DISSIPATION_CONSTANT = 0.5   # C_eps = eps L / u'^3 of developed turbulence
DECAY_EXPONENT = 1.2         # of the energy of turbulence that nothing forces (Saffman 1967)
PEAK_VELOCITY = 4.0          # largest component of the velocity of a particle over u'
ALLOWED_VELOCITY = 6.0       # the same, for which there are ghost planes in the training through horizons
PEAK_SPEED = 7.0             # max(|u| + |v| + |w|) over u' in turbulence: four rms in each component at worst
GHOST_PLANES = {"cubic": 3, "quintic": 4}


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

    def decayed(self, time: float) -> float:
        """u' a time after the forcing has ended: the energy E falls as (1 + eps t / (n E))^-n, n = DECAY_EXPONENT."""
        energy = 1.5 * self.velocity_rms**2
        lost = self.dissipation_rate * time / (DECAY_EXPONENT * energy)
        return self.velocity_rms * (1 + lost) ** (-DECAY_EXPONENT / 2)

    @property
    def reynolds_lambda(self) -> float:
        """Re_lambda = u' lambda / nu with lambda = (15 nu u'^2 / eps)^(1/2)."""
        return self.velocity_rms**2 * math.sqrt(15 / (self.viscosity * self.dissipation_rate))


def largest_wavenumber(scene: Scene) -> int:
    """k_max kept by the 2/3 rule: the largest integer below cells / 3."""
    return (scene.flow.cells - 1) // 3


def expected_turbulence(scene: Scene) -> ExpectedTurbulence | None:
    """Turbulence kept up by the forcing, or decaying from a random start; None if not to be foreseen.

    The integral scale is taken as sqrt(2 pi) / k with k of the forcing or of the initial peak, which is
    exact for the initial spectrum and holds within some 10 % for forced turbulence.
    """
    if scene.flow.viscosity == 0:
        return None
    if scene.forcing and scene.forcing.injection_rate > 0:
        integral_scale = math.sqrt(2 * math.pi) / scene.forcing.wavenumber
        dissipation_rate = scene.forcing.injection_rate
        velocity_rms = (dissipation_rate * integral_scale / DISSIPATION_CONSTANT) ** (1 / 3)
        return ExpectedTurbulence(velocity_rms, dissipation_rate, scene.flow.viscosity)
    if scene.initial.flow.turbulent:
        integral_scale = math.sqrt(2 * math.pi) / scene.initial.peak_wavenumber
        dissipation_rate = DISSIPATION_CONSTANT * scene.initial.amplitude**3 / integral_scale
        return ExpectedTurbulence(scene.initial.amplitude, dissipation_rate, scene.flow.viscosity)
    return None


def peak_speed(scene: Scene) -> float | None:
    """Expected largest |u| + |v| + |w|; None without forcing for a flow from a file or of the user's."""
    initial, turbulence = scene.initial, expected_turbulence(scene)
    if turbulence:
        return PEAK_SPEED * turbulence.velocity_rms
    if initial.flow.turbulent:
        return PEAK_SPEED * initial.amplitude
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


def expected_step(scene: Scene) -> tuple[float, str] | None:
    """The time step of the direct simulation and what limits it; None if the speed cannot be foreseen."""
    settings, bound = scene.time, courant_bound(scene)
    if settings.step is not None:
        return settings.step, "fixed by [time] step"
    if bound is None:
        return None
    if bound >= settings.max_step:
        return settings.max_step, "limited by [time] max_step"
    limit = "sound, which rk4 must resolve" if explicit_sound(scene) > peak_speed(scene) else "advection"
    return ladder_step(settings.max_step, bound), f"limited by {limit}: at most {bound:.3g}"


def courant_bound(scene: Scene) -> float | None:
    """The longest step of the direct simulation by its Courant number; None if the speed cannot be foreseen."""
    speed = peak_speed(scene)
    return None if speed is None else (
        scene.time.courant * BOX_LENGTH / scene.flow.cells / (speed + explicit_sound(scene)))


def explicit_sound(scene: Scene) -> float:
    """sqrt(3) c where the stepper must resolve sound, else 0."""
    return math.sqrt(3) * scene.flow.sound_speed if scene.time.explicit and scene.flow.sound_speed else 0.0


def run_time(scene: Scene) -> float | None:
    """Physical time that the direct simulation covers; None where the turnover time cannot be foreseen."""
    parts = [time_of(scene, part.turnovers) for part in (scene.spin_up, scene.tracers) if part]
    return None if None in parts else sum(parts) + (scene.time.duration or 0.0)


def time_of(scene: Scene, turnovers: float) -> float | None:
    """Physical time of so many turnovers; None where the turnover time cannot be foreseen."""
    turbulence = expected_turbulence(scene)
    return turbulence and turnovers * turbulence.turnover_time


def tracer_intervals(scene: Scene) -> int | None:
    """Frame intervals through which tracers are followed; None where that is not foreseen."""
    span = time_of(scene, scene.tracers.turnovers)
    return span and max(math.ceil(span / scene.tracers.frame_interval - 1e-9), 1)


def flow_steps(scene: Scene) -> tuple[int, int] | None:
    """Steps of the direct simulation without tracers and, equal ones within each frame interval, with them; None if
    they cannot be foreseen."""
    expected, span = expected_step(scene), run_time(scene)
    if expected is None or not span:
        return None
    step, intervals = expected[0], tracer_intervals(scene) if scene.tracers else 0
    alone = time_of(scene, scene.spin_up.turnovers) if scene.spin_up else 0.0
    before = math.ceil((alone + (scene.time.duration or 0.0)) / step - 1e-9)
    if not intervals:
        return before, 0
    interval = scene.tracers.frame_interval
    longest = min(scene.time.step or courant_bound(scene), scene.time.max_step)
    return before, intervals * math.ceil(interval / longest - 1e-9)


def most_ranks(scene: Scene) -> dict[str, int]:
    """The largest number of ranks that each part of a run can use, by what limits it."""
    limits = {"a grid plane each": scene.flow.cells}
    if scene.tracers:
        splines = scene.tracers.interpolation
        ghosts = GHOST_PLANES[splines]
        limits[f"{ghosts} ghost planes of the {splines} splines"] = scene.flow.cells // ghosts
    if scene.tracers and scene.kernel:
        limits[f"slabs of the fields no thinner than the kernel's support {scene.kernel_support:.3g}"] = thick_slabs(
            scene.tracers.cells, scene.kernel_support)
    if sees_pairs(scene):
        reach = particle_reach(scene)
        limits[f"slabs no thinner than the particles' reach {reach:.3g}"] = thick_slabs(scene.tracers.planes, reach)
    if "train" in scene.stages:
        limits |= most_training_ranks(scene)
    if scene.simulation and scene.simulation.on_grid:
        cells = (scene.eulerian or Eulerian()).cells_for(scene.tracers.filter_width)
        limits["ghost planes of the coarse grid"] = max(cells // GHOST_PLANES[scene.tracers.interpolation], 1)
    elif scene.injects:
        reach = scene.simulation.skin * scene.interaction_radius / 2
        limits["ghost planes of the resolved velocity"] = ranks_of_resolved_grid(scene.tracers, reach)
    fewest = min(limits.values())
    return limits | {f"variant {name}: {reason}": ranks for name, variant in scene.variant.items()
                     for reason, ranks in most_ranks(variant).items() if ranks < fewest}


def most_training_ranks(scene: Scene) -> dict[str, int]:
    """The same for what a model is trained on and by."""
    # The a-priori test interpolates filtered fields to the particles, terms what they make of the resolved velocity.
    limits = {"ghost planes of the filtered fields": max(scene.tracers.cells // GHOST_PLANES["quintic"], 1)}
    if scene.resolves:
        skin = scene.simulation.skin * scene.interaction_radius if scene.simulation else 0.0
        limits["ghost planes of the resolved velocity"] = ranks_of_resolved_grid(scene.tracers, skin / 2)
    turbulence = expected_turbulence(scene)
    limits |= most_horizon_ranks(scene, scene.tracers, turbulence.velocity_rms if turbulence else 0.0)
    return limits | most_ranks_of_truths(scene)


def most_horizon_ranks(scene: Scene, tracers: Tracers, velocity: float) -> dict[str, int]:
    """The same for what trains through horizons, among tracers of an rms `velocity` of a component."""
    time, radius, limits = horizon_time(scene), tracers.radius_of(scene.neighbors), {}
    if time > 0:
        if learns_pairs(scene):
            reach = radius + 2 * PEAK_VELOCITY * velocity * time
            limits[f"slabs no thinner than the particles' reach {reach:.3g} in the training through horizons"] = (
                thick_slabs(tracers.planes, reach))
        if scene.training.horizons.energy_weight > 0 or scene.resolves:
            limits["ghost planes of the grid in the training through horizons"] = ranks_of_resolved_grid(
                tracers, ALLOWED_VELOCITY * velocity * time)
    return limits


def most_ranks_of_truths(scene: Scene) -> dict[str, int]:
    """The strictest limit of each ground truth that [training] names and that is there: it may have another number of
    tracers, and move otherwise."""
    limits = {}
    named = zip(scene.training.truths or (), scene.training.truth_files) if scene.training else ()
    for name, path in named if scene.model.path is None else ():
        if "spacing" not in (reference := product_attributes(path, "reference")):
            continue
        tracers = replace(scene.tracers, particles_per_side=round(BOX_LENGTH / reference["spacing"]))
        found = most_horizon_ranks(scene, tracers, reference["velocity_rms"])
        if learns_pairs(scene):
            reach = tracers.radius_of(scene.neighbors)
            found[f"slabs no thinner than the particles' reach {reach:.3g}"] = thick_slabs(tracers.planes, reach)
        if scene.resolves or product_attributes(path, "forcing"):
            found["ghost planes of the resolved velocity"] = ranks_of_resolved_grid(tracers, 0.0)
        if found:
            reason = min(found, key=found.__getitem__)
            limits[f"[training] truths: {quoted(name)}: {reason}"] = found[reason]
    return limits


def learns_pairs(scene: Scene) -> bool:
    """Whether a model is trained or taken that looks at pairs of particles."""
    return "train" in scene.stages and "pairs" in scene.model.reads


def sees_pairs(scene: Scene) -> bool:
    """Whether particles interact in pairs, in a training or in a rollout."""
    return learns_pairs(scene) or scene.simulation is not None and "pairs" in scene.simulation.needs


def ground_truth_alone(scene: Scene) -> Scene:
    """The scene without what learns of its ground truth, which may use more ranks."""
    return replace(scene.without_variants, kernel=None, model=None, training=None, simulation=None, eulerian=None)


def thick_slabs(planes: int, width: float) -> int:
    """The largest number of slabs of that many planes in all that are no thinner than `width`."""
    return max(planes // math.ceil(width / (BOX_LENGTH / planes) - 1e-9), 1)


def particle_reach(scene: Scene) -> float:
    """How thick slabs must be for the particles: radius of interaction, and skin of the neighbour list."""
    return scene.interaction_radius * (1 + (scene.simulation.skin if scene.simulation else 0.0))


def resolved_shells(scene: Scene) -> int:
    """Highest wavenumber, along each axis, of the velocity that the particles resolve."""
    tracers, turbulence = scene.tracers, expected_turbulence(scene)
    highest = resolved_wavenumber(tracers.spacing, tracers.filter_width,
                                  turbulence.kolmogorov_length if turbulence else 0.0)
    return min(max(int(highest + 1e-9), 1), (tracers.planes - 1) // 2)


def foreseen_allowed_step(scene: Scene) -> float | None:
    """The longest time step that particles with a resolved velocity can take in the turbulence that is expected, amid
    their rollout where it decays; None where it is not foreseen."""
    turbulence = expected_turbulence(scene)
    if turbulence is None:
        return None
    settings = scene.simulation
    speed = turbulence.velocity_rms
    if not scene.injects:
        start = scene.seen_in(scene.directory) if settings.start is None else settings.start
        turnovers = start * scene.tracers.turnovers + settings.turnovers / 2
        speed = turbulence.decayed(turnovers * turbulence.turnover_time)
    return allowed_step(settings.scheme.angle, resolved_shells(scene), speed)


def horizon_time(scene: Scene) -> float:
    """The longest time through which a model is trained and particles keep their rank; 0 without such training."""
    horizons = scene.training and scene.training.horizons
    if horizons is None or scene.model.path is not None:
        return 0.0
    return max(horizons.frames) * scene.tracers.frame_interval


def ranks_of_resolved_grid(tracers: Tracers, outside: float) -> int:
    """The largest number of ranks for the cubic splines on the grid of the resolved velocity, which have one more ghost
    plane for each plane that a particle may be outside its slab."""
    planes = tracers.planes
    ghosts = GHOST_PLANES["cubic"] - 1 + max(math.ceil(outside * planes / BOX_LENGTH - 1e-9), 1)
    return max(planes // ghosts, 1)
