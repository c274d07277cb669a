"""What is likely to go wrong with a scene, in words: key, value, why, and what to do. `check` tells all of it, a stage
that starts what concerns it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator

from eddies.flow.stability import REMEDIES, limits_of_step
from eddies.scene.scene import BOX_LENGTH, Scene
from eddies.scene.terms import StepUnits
from eddies.workflows.foreseen.estimates import (courant_bound, expected_turbulence, foreseen_allowed_step,
                                                 largest_wavenumber, most_ranks, peak_speed, rms_speed)

LARGEST_MACH = 0.3           # turbulent Mach number up to which density fluctuations, of about its square, are small
LEAST_REYNOLDS = 5.0         # Re_lambda from which on there is an inertial transfer from scale to scale
KMAX_ETA = 1.0, 4.0          # that resolves the dissipation, and more than anybody needs


def stage_warnings(scene: Scene, stages: Iterable[str]) -> Iterator[str]:
    """The warnings that concern some of the stages that a scene has, a line each."""
    for stage in stages:
        for subject in SUBJECTS.get(stage, ()):
            yield from subject(scene)


def warnings(scene: Scene, ranks: int) -> Iterator[str]:
    """Those of all stages, and of the number of ranks."""
    yield from stage_warnings(scene, scene.stages)
    most = min(most_ranks(scene).values())
    if ranks > most:
        yield f"this job has {ranks} ranks, and the scene can use at most {most}: start fewer"


def resolution(scene: Scene) -> Iterator[str]:
    """Grids too coarse for the dissipation, or much finer than it needs."""
    turbulence, k_max, (least, most) = expected_turbulence(scene), largest_wavenumber(scene), KMAX_ETA
    if turbulence is None:
        return
    reached = k_max * turbulence.kolmogorov_length
    viscosity = (least / k_max) ** (4 / 3) * turbulence.dissipation_rate ** (1 / 3)
    cells = math.ceil(3 * least / turbulence.kolmogorov_length) + 1
    if reached < least * (1 - 1e-3):
        yield (f"[flow] cells = {scene.flow.cells}: k_max eta is about {reached:.2g}, below {least:g}, so that the "
               f"dissipation is not resolved; raise cells to {cells}, or viscosity to {at_least(viscosity)}")
    elif reached > most:
        yield (f"[flow] cells = {scene.flow.cells}: k_max eta is about {reached:.2g}, and 1 to 2 resolve the "
               f"dissipation: a step costs {(reached / 2)**3:.0f} times what it could; lower cells to {2 * cells}, or "
               f"viscosity to {viscosity * 2**(4 / 3):.2g}")


def compressibility(scene: Scene) -> Iterator[str]:
    """Sound too slow for what flows."""
    speed, sound = rms_speed(scene), scene.flow.sound_speed
    if speed is None or sound is None or speed <= LARGEST_MACH * sound:
        return
    remedy = f"raise sound_speed to {at_least(speed / LARGEST_MACH)} or more"
    if speed > sound:
        yield (f"[flow] sound_speed = {sound:g}: the flow is supersonic, with a turbulent Mach number of about "
               f"{speed / sound:.2g}: shocks come, which nothing here resolves; {remedy}")
    else:
        yield (f"[flow] sound_speed = {sound:g}: the turbulent Mach number is about {speed / sound:.2g}, above "
               f"{LARGEST_MACH:g}: fluid, balanced start and models take the density for nearly uniform and know no "
               f"shocks; {remedy}")


def turbulence_at_all(scene: Scene) -> Iterator[str]:
    """Viscosity that leaves no turbulence."""
    turbulence = expected_turbulence(scene)
    if turbulence is None or turbulence.reynolds_lambda >= LEAST_REYNOLDS:
        return
    reached = turbulence.reynolds_lambda
    why = ("nothing is turbulent: viscosity stops an eddy before it turns over" if reached < 1 else
           f"below {LEAST_REYNOLDS:g} eddies decay where they are made, without smaller ones")
    yield (f"[flow] viscosity = {scene.flow.viscosity:g}: Re_lambda is about {reached:.2g}, {why}; lower viscosity to "
           f"{at_most(scene.flow.viscosity * (reached / LEAST_REYNOLDS)**2)} or less")


def stability(scene: Scene) -> Iterator[str]:
    """Steps of the direct simulation beyond what its stepper can take."""
    settings, bound = scene.time, courant_bound(scene)
    step = settings.step or min(bound or 0.0, settings.max_step)
    limits = limits_of_step(largest_wavenumber(scene), step, peak_speed(scene) or 0.0, scene.flow.viscosity,
                            settings.explicit, scene.flow.sound_speed)
    for limit in limits:
        if limit.exceeded:
            key = "step" if settings.step else "max_step" if limit.name == "viscosity" else "courant"
            yield f"[time] {key} = {getattr(settings, key):g}: is unstable by {limit}; {REMEDIES[limit.name]}"


def filter_width(scene: Scene) -> Iterator[str]:
    """Filters that filter nothing, or leave nothing."""
    if scene.tracers is None:
        return
    width, forcing = scene.tracers.filter_width, scene.forcing
    if width < BOX_LENGTH / scene.flow.cells:
        yield (f"[tracers] filter_width = {width:.3g}: the filter is narrower than a cell of the grid, it filters "
               f"nothing; raise it to {at_least(BOX_LENGTH / scene.flow.cells)} or more, or lower [tracers] "
               "particles_per_side")
    if forcing is None and not scene.initial.flow.turbulent:
        return
    highest, holds = ((forcing.wavenumber, "that are forced") if forcing else
                      (scene.initial.peak_wavenumber, "that hold the energy"))
    if math.pi / width < highest * (1 - 1e-9):
        yield (f"[tracers] filter_width = {width:.3g}: passes wavenumbers up to {math.pi / width:.2g}, less than the "
               f"{highest:g} of the scales {holds}, so that little of the flow is left; lower it to "
               f"{at_most(math.pi / highest)} or less, or raise particles_per_side")


def learning(scene: Scene) -> Iterator[str]:
    """Weights that are not there, and terms that nothing trains."""
    model = scene.model
    if model.path and not model.weights_file.is_file():
        yield f'[model] path = "{model.path}": there is no {model.weights_file} yet, which `eddies train` will want'
    if scene.training and model.path is None and scene.training.horizons is None:
        for name, settings in model.settings.items():
            if settings.learns_through_horizons:
                yield (f'[model] terms: "{name}" is trained through horizons alone, and stays as it starts without '
                       "them: add [training.horizons]")


def rollout_steps(scene: Scene) -> Iterator[str]:
    """Steps of particles that forcing keeps too fast for them."""
    settings = scene.simulation
    if "model" not in settings.needs or not scene.injects:
        return
    allowed = foreseen_allowed_step(scene)
    if allowed and settings.step > allowed * (1 + 1e-9):
        yield (f"[simulation] step = {settings.step:g}: the particles will take shorter steps, of about "
               f"{at_most(allowed)}, in which their resolved velocity can follow the flow; lower it to that")


def term_steps(scene: Scene) -> Iterator[str]:
    """Steps that are too long for terms: in which sound outruns particles, or they relax too far."""
    settings, speed = scene.simulation, rms_speed(scene)
    if "model" not in settings.needs:
        return
    units = StepUnits(radius=scene.interaction_radius, filter_width=scene.tracers.filter_width,
                      sound_speed=scene.flow.sound_speed, scheme=settings.scheme,
                      velocity=None if speed is None else speed / math.sqrt(3))
    for name, term in scene.model.settings.items():
        longest = term.longest_step(units)
        if settings.step > longest:
            yield f"[simulation] step = {settings.step:g}: " + term.too_long.format(
                name=name, longest=at_most(longest), integrator=settings.integrator)


def at_least(value: float) -> str:
    """Two digits, rounded up."""
    return f"{math.ceil(value / _second_digit(value) - 1e-9) * _second_digit(value):.2g}"


def at_most(value: float) -> str:
    """Two digits, rounded down."""
    return f"{math.floor(value / _second_digit(value) + 1e-9) * _second_digit(value):.2g}"


def _second_digit(value: float) -> float:
    return 10.0 ** (math.floor(math.log10(value)) - 1)


SUBJECTS: dict[str, tuple[Callable[[Scene], Iterator[str]], ...]] = {
    "dns": (resolution, compressibility, turbulence_at_all, stability, filter_width),
    "train": (learning,), "simulate": (rollout_steps, term_steps)}
