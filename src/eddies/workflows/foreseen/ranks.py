"""How many ranks a scene can use, and what limits them: ghost planes of slabs, and the reach of particles."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

from eddies.io.provenance import product_attributes
from eddies.scene.integrators import MOST_COURANT
from eddies.scene.rules import quoted
from eddies.scene.scene import BOX_LENGTH, Eulerian, Scene, Tracers
from eddies.workflows.foreseen.numbers import expected_turbulence

PEAK_VELOCITY = 4.0          # largest component of the velocity of a particle over u'
ALLOWED_VELOCITY = 6.0       # the same, for which the training through horizons has ghost planes
GHOST_PLANES = {"cubic": 3, "quintic": 4}


def most_ranks(scene: Scene) -> dict[str, int]:
    """The largest number of ranks by what limits it; of variants, the limits that are stricter than the scene's."""
    limits, tracers = {"a grid plane each": scene.flow.cells}, scene.tracers
    if tracers:
        splines = tracers.interpolation
        ghosts = GHOST_PLANES[splines]
        limits[f"{ghosts} ghost planes of the {splines} splines"] = scene.flow.cells // ghosts
    if tracers and scene.kernel:
        limits[f"slabs of the fields no thinner than the kernel's support {scene.kernel_support:.3g}"] = thick_slabs(
            tracers.cells, scene.kernel_support)
    if learns_pairs(scene) or scene.simulation is not None and "pairs" in scene.simulation.needs:
        reach = scene.interaction_radius + 2 * half_skin(scene)
        limits[f"slabs no thinner than the particles' reach {reach:.3g}"] = thick_slabs(tracers.planes, reach)
    if "train" in scene.stages:
        limits |= most_training_ranks(scene)
    if scene.simulation and scene.simulation.on_grid:
        cells = (scene.eulerian or Eulerian()).cells_for(tracers.filter_width)
        # In one step particles move through as many cells as the Courant number.
        farther = math.ceil(max(scene.time.courant, MOST_COURANT * scene.simulation.finds_step)) - 1
        ghosts = GHOST_PLANES[tracers.interpolation] + farther
        limits["ghost planes of the coarse grid"] = max(cells // ghosts, 1)
    elif scene.injects:
        limits["ghost planes of the resolved velocity"] = ranks_of_resolved_grid(tracers, half_skin(scene))
    fewest = min(limits.values())
    return limits | {f"variant {name}: {reason}": ranks for name, variant in scene.variant.items()
                     for reason, ranks in most_ranks(variant).items() if ranks < fewest}


def most_training_ranks(scene: Scene) -> dict[str, int]:
    """Limits of the training of the model. A ground truth of another run may have other particles; its strictest limit
    counts."""
    # The a-priori test interpolates filtered fields to the particles.
    limits = {"ghost planes of the filtered fields": max(scene.tracers.cells // GHOST_PLANES["quintic"], 1)}
    if scene.resolves:
        limits["ghost planes of the resolved velocity"] = ranks_of_resolved_grid(scene.tracers, half_skin(scene))
    turbulence = expected_turbulence(scene)
    limits |= most_horizon_ranks(scene, scene.tracers, turbulence.velocity_rms if turbulence else 0.0)
    if scene.training is None or scene.training.truths is None or scene.model.path is not None:
        return limits
    for name, path in zip(scene.training.truths, scene.training.truth_files):
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


def most_horizon_ranks(scene: Scene, tracers: Tracers, velocity: float) -> dict[str, int]:
    """Limits of the training through horizons, in which no particle changes its rank; `velocity` is the rms of a
    component."""
    horizons, limits = scene.training and scene.training.horizons, {}
    if horizons is None or scene.model.path is not None:
        return limits
    time = max(horizons.frames) * tracers.frame_interval
    if learns_pairs(scene):
        reach = tracers.radius_of(scene.neighbors) + 2 * PEAK_VELOCITY * velocity * time
        limits[f"slabs no thinner than the particles' reach {reach:.3g} in the training through horizons"] = (
            thick_slabs(tracers.planes, reach))
    if horizons.energy_weight > 0 or scene.resolves:
        limits["ghost planes of the grid in the training through horizons"] = ranks_of_resolved_grid(
            tracers, ALLOWED_VELOCITY * velocity * time)
    return limits


def rank_problems(scene: Scene, stages: Sequence[str], ranks: int) -> Iterator[str]:
    """Too many ranks for some stages of a scene; the ground truth alone may use more."""
    limits = most_ranks(ground_truth_alone(scene) if set(stages) == {"dns"} else scene)
    reason = min(limits, key=limits.__getitem__)
    if ranks > limits[reason]:
        yield (f"{ranks} ranks are more than the {limits[reason]} that it can use ({reason}); start at most "
               f"{limits[reason]}, `eddies check` gives all limits")


def ground_truth_alone(scene: Scene) -> Scene:
    """The scene without kernel, model and rollout."""
    return replace(scene.without_variants, kernel=None, model=None, training=None, simulation=None, eulerian=None)


def learns_pairs(scene: Scene) -> bool:
    """Whether the scene trains a model, or takes one, that reads pairs of particles."""
    return "train" in scene.stages and "pairs" in scene.model.reads


def half_skin(scene: Scene) -> float:
    """How far a particle may leave its slab before the neighbour list is built again."""
    return scene.simulation.skin * scene.interaction_radius / 2 if scene.simulation else 0.0


def thick_slabs(planes: int, width: float) -> int:
    """The largest number of slabs, cut from a number of planes, that are no thinner than `width`."""
    return max(planes // math.ceil(width / (BOX_LENGTH / planes) - 1e-9), 1)


def ranks_of_resolved_grid(tracers: Tracers, outside: float) -> int:
    """The largest number of ranks for the cubic splines on the grid of the resolved velocity. They need one more ghost
    plane for each plane that a particle may be outside its slab."""
    planes = tracers.planes
    ghosts = GHOST_PLANES["cubic"] - 1 + max(math.ceil(outside * planes / BOX_LENGTH - 1e-9), 1)
    return max(planes // ghosts, 1)
