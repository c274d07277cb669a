"""The number of ranks that a scene can use. Ghost planes of slabs and the reach of particles limit it."""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path

from eddies.io.provenance import product_attributes
from eddies.scene.integrators import MOST_COURANT
from eddies.scene.rules import quoted
from eddies.scene.scene import BOX_LENGTH, Horizons, Scene, Tracers
from eddies.scene.sections import NEIGHBORS
from eddies.workflows.foreseen.numbers import expected_turbulence

PEAK_VELOCITY = 4.0          # largest component of the velocity of a particle, divided by u'
ALLOWED_VELOCITY = 6.0       # largest such ratio that the training through horizons allows
GHOST_PLANES = {"cubic": 3, "quintic": 4}
RESOLVED = "ghost planes of the resolved velocity"


def most_ranks(scene: Scene) -> dict[str, int]:
    """Return the largest number of ranks that each limit allows, by the name of the limit. A limit of a variant is
    included if it is below all limits of the scene."""
    limits, tracers, simulation = {"a grid plane for each rank": scene.flow.cells}, scene.tracers, scene.simulation
    skin = simulation.skin * scene.interaction_radius if simulation else 0.0
    trains = "train" in scene.stages
    learned_neighbors = scene.neighbors if trains and "pairs" in scene.model.reads else 0.0
    if tracers:
        ghosts = GHOST_PLANES[tracers.interpolation]
        limits[f"{ghosts} ghost planes of the {tracers.interpolation} splines"] = scene.flow.cells // ghosts
    if scene.kernel:
        support = scene.kernel_support
        limits[f"slabs of the fields, at least as thick as the kernel's support {support:.3g}"] = thick_slabs(
            tracers.cells, support)
    if learned_neighbors or simulation is not None and "pairs" in simulation.needs:
        limits |= reach_limit(tracers, scene.interaction_radius + skin)
    if trains:
        # The a-priori test interpolates filtered fields to the particles.
        limits["ghost planes of the filtered fields"] = max(tracers.cells // GHOST_PLANES["quintic"], 1)
        if scene.needs_resolved_velocity:
            limits[RESOLVED] = resolved_grid_ranks(tracers, skin / 2)
    if trains and scene.own_training:
        turbulence = expected_turbulence(scene.flow, scene.initial, scene.forcing)
        horizons, truths = scene.own_training.horizons, scene.own_training.truths or ()
        limits |= horizon_limits(horizons, tracers, turbulence.velocity_rms if turbulence else 0.0, learned_neighbors,
                                 scene.needs_resolved_velocity)
        for name, path in zip(truths, scene.own_training.truth_files):
            found = truth_limits(path, horizons, tracers, learned_neighbors, scene.needs_resolved_velocity)
            if found:
                reason = min(found, key=found.__getitem__)
                limits[f"[training] truths: {quoted(name)}: {reason}"] = found[reason]
    if scene.reconstruction:
        limits[RESOLVED] = resolved_grid_ranks(tracers, 0.0)
        if scene.reconstruction.of_neighbors:
            limits |= reach_limit(tracers, scene.kernel_support or tracers.radius_of(NEIGHBORS))
    if scene.coarse_cells:
        # In one step a particle crosses at most as many cells as the Courant number.
        farther = math.ceil(max(scene.time.courant, MOST_COURANT * simulation.finds_step)) - 1
        ghosts = GHOST_PLANES[tracers.interpolation] + farther
        limits["ghost planes of the coarse grid"] = max(scene.coarse_cells // ghosts, 1)
        if scene.eulerian and scene.eulerian.start == "particles":
            limits[RESOLVED] = resolved_grid_ranks(tracers, 0.0)
    elif scene.rollout_is_forced:
        limits[RESOLVED] = resolved_grid_ranks(tracers, skin / 2)
    fewest = min(limits.values())
    return limits | {f"variant {name}: {reason}": ranks for name, variant in scene.variant.items()
                     for reason, ranks in most_ranks(variant).items() if ranks < fewest}


def horizon_limits(horizons: Horizons | None, tracers: Tracers, velocity: float, neighbors: float,
                   needs_resolved_velocity: bool) -> dict[str, int]:
    """Return the limits on the number of ranks in the training through horizons, where particles stay on their rank.

    `velocity` is the rms of a velocity component. `neighbors` is 0 for a model without pairs.
    """
    limits: dict[str, int] = {}
    if horizons is None:
        return limits
    time = max(horizons.frames) * tracers.frame_interval
    if neighbors:
        limits |= reach_limit(tracers, tracers.radius_of(neighbors) + 2 * PEAK_VELOCITY * velocity * time,
                              " in the training through horizons")
    if horizons.energy_weight > 0 or needs_resolved_velocity:
        limits["ghost planes of the grid in the training through horizons"] = resolved_grid_ranks(
            tracers, ALLOWED_VELOCITY * velocity * time)
    return limits


def truth_limits(path: Path, horizons: Horizons | None, tracers: Tracers, neighbors: float,
                 needs_resolved_velocity: bool) -> dict[str, int]:
    """Return the limits on the number of ranks, by reason, if a model is trained on another run's ground truth `path`.

    This ground truth may have another number of particles than `tracers`. The result is empty if there is no such file.
    """
    reference = product_attributes(path, "reference")
    if "spacing" not in reference:
        return {}
    tracers = tracers.with_count(round((BOX_LENGTH / reference["spacing"]) ** 3))
    limits = horizon_limits(horizons, tracers, reference["velocity_rms"], neighbors, needs_resolved_velocity)
    if neighbors:
        limits |= reach_limit(tracers, tracers.radius_of(neighbors))
    if needs_resolved_velocity or product_attributes(path, "forcing"):
        limits[RESOLVED] = resolved_grid_ranks(tracers, 0.0)
    return limits


def rank_problems(limits: Mapping[str, int], ranks: int) -> Iterator[str]:
    """Yield a message if there are more ranks than the strictest limit allows."""
    reason = min(limits, key=limits.__getitem__)
    if ranks > limits[reason]:
        yield (f"{ranks} ranks are more than the limit of {limits[reason]} ({reason}); start at most {limits[reason]}. "
               "`eddies check` lists all limits")


def reach_limit(tracers: Tracers, reach: float, when: str = "") -> dict[str, int]:
    """Return the limit that `reach`, the range of the interaction of particles, sets to the number of ranks, as a dict
    {name: ranks}. The name ends with `when`."""
    return {f"slabs, at least as thick as the particles' reach {reach:.3g}{when}": thick_slabs(tracers.planes, reach)}


def thick_slabs(planes: int, width: float) -> int:
    """Return the largest number of slabs into which the planes of a grid can be divided if no slab may be thinner than
    `width`."""
    return max(planes // math.ceil(width / (BOX_LENGTH / planes) - 1e-9), 1)


def resolved_grid_ranks(tracers: Tracers, outside: float) -> int:
    """Return the largest number of ranks for cubic splines on the grid of the resolved velocity.

    A particle may leave its slab by the distance `outside`. The splines need one more ghost plane for each plane within
    this distance.
    """
    planes = tracers.planes
    ghosts = GHOST_PLANES["cubic"] - 1 + max(math.ceil(outside * planes / BOX_LENGTH - 1e-9), 1)
    return max(planes // ghosts, 1)
