"""How many ranks a scene can use, and why no more: slabs hold ghost planes, and are as thick as particles see."""

import math
from dataclasses import replace

from eddies.io.provenance import product_attributes
from eddies.scene.rules import quoted
from eddies.scene.integrators import MOST_COURANT
from eddies.scene.scene import BOX_LENGTH, Eulerian, Scene, Tracers
from eddies.workflows.foreseen.numbers import expected_turbulence

PEAK_VELOCITY = 4.0          # largest component of the velocity of a particle over u'
ALLOWED_VELOCITY = 6.0       # the same, for which there are ghost planes in the training through horizons
GHOST_PLANES = {"cubic": 3, "quintic": 4}


def most_ranks(scene: Scene) -> dict[str, int]:
    """The largest number of ranks that each part of a run can use, by what limits it; of variants those below."""
    limits, tracers = {"a grid plane each": scene.flow.cells}, scene.tracers
    if tracers:
        splines = tracers.interpolation
        ghosts = GHOST_PLANES[splines]
        limits[f"{ghosts} ghost planes of the {splines} splines"] = scene.flow.cells // ghosts
    if tracers and scene.kernel:
        limits[f"slabs of the fields no thinner than the kernel's support {scene.kernel_support:.3g}"] = thick_slabs(
            tracers.cells, scene.kernel_support)
    if learns_pairs(scene) or scene.simulation is not None and "pairs" in scene.simulation.needs:
        reach = particle_reach(scene)
        limits[f"slabs no thinner than the particles' reach {reach:.3g}"] = thick_slabs(tracers.planes, reach)
    if "train" in scene.stages:
        limits |= most_training_ranks(scene)
    if scene.simulation and scene.simulation.on_grid:
        cells = (scene.eulerian or Eulerian()).cells_for(tracers.filter_width)
        # Particles move through as many cells in a step as the Courant number tells.
        farther = math.ceil(max(scene.time.courant, MOST_COURANT * scene.simulation.finds_step)) - 1
        ghosts = GHOST_PLANES[tracers.interpolation] + farther
        limits["ghost planes of the coarse grid"] = max(cells // ghosts, 1)
    elif scene.injects:
        limits["ghost planes of the resolved velocity"] = ranks_of_resolved_grid(tracers, half_skin(scene))
    fewest = min(limits.values())
    return limits | {f"variant {name}: {reason}": ranks for name, variant in scene.variant.items()
                     for reason, ranks in most_ranks(variant).items() if ranks < fewest}


def most_training_ranks(scene: Scene) -> dict[str, int]:
    """The same for what a model is trained on and by."""
    # The a-priori test interpolates filtered fields to the particles, terms what they make of the resolved velocity.
    limits = {"ghost planes of the filtered fields": max(scene.tracers.cells // GHOST_PLANES["quintic"], 1)}
    if scene.resolves:
        limits["ghost planes of the resolved velocity"] = ranks_of_resolved_grid(scene.tracers, half_skin(scene))
    turbulence = expected_turbulence(scene)
    limits |= most_horizon_ranks(scene, scene.tracers, turbulence.velocity_rms if turbulence else 0.0)
    return limits | most_ranks_of_truths(scene)


def most_horizon_ranks(scene: Scene, tracers: Tracers, velocity: float) -> dict[str, int]:
    """The same for what trains through horizons, among tracers of an rms `velocity` of a component: no particle changes
    its rank within one."""
    horizons, limits = scene.training and scene.training.horizons, {}
    if horizons is None or scene.model.path is not None:
        return limits
    time = max(horizons.frames) * scene.tracers.frame_interval
    if learns_pairs(scene):
        reach = tracers.radius_of(scene.neighbors) + 2 * PEAK_VELOCITY * velocity * time
        limits[f"slabs no thinner than the particles' reach {reach:.3g} in the training through horizons"] = (
            thick_slabs(tracers.planes, reach))
    if horizons.energy_weight > 0 or scene.resolves:
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


def ground_truth_alone(scene: Scene) -> Scene:
    """The scene without what learns of its ground truth, which may use more ranks."""
    return replace(scene.without_variants, kernel=None, model=None, training=None, simulation=None, eulerian=None)


def learns_pairs(scene: Scene) -> bool:
    """Whether a model is trained or taken that looks at pairs of particles."""
    return "train" in scene.stages and "pairs" in scene.model.reads


def particle_reach(scene: Scene) -> float:
    """How thick slabs must be for the particles: radius of interaction, and skin of the neighbour list."""
    return scene.interaction_radius + 2 * half_skin(scene)


def half_skin(scene: Scene) -> float:
    """How far a particle may move out of its slab before the neighbour list is made again."""
    return scene.simulation.skin * scene.interaction_radius / 2 if scene.simulation else 0.0


def thick_slabs(planes: int, width: float) -> int:
    """The largest number of slabs of that many planes in all that are no thinner than `width`."""
    return max(planes // math.ceil(width / (BOX_LENGTH / planes) - 1e-9), 1)


def ranks_of_resolved_grid(tracers: Tracers, outside: float) -> int:
    """The largest number of ranks for the cubic splines on the grid of the resolved velocity, which have one more ghost
    plane for each plane that a particle may be outside its slab."""
    planes = tracers.planes
    ghosts = GHOST_PLANES["cubic"] - 1 + max(math.ceil(outside * planes / BOX_LENGTH - 1e-9), 1)
    return max(planes // ghosts, 1)
