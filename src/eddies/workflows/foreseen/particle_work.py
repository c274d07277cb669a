"""What one evaluation of a particle model has to do, and what of it falls to the busiest of so many ranks."""

from __future__ import annotations

import math
from dataclasses import dataclass

from eddies.scene.scene import BOX_LENGTH, Scene
from eddies.workflows.foreseen.cost_model import busiest_planes
from eddies.workflows.foreseen.estimates import expected_turbulence, resolved_shells
from eddies.workflows.foreseen.rollout_course import rollout_step

# Sums over ranks: of an iteration; of the rest of an evaluation with the built-in terms; of a settling.
SUMS_OF_ITERATION, SUMS_OF_EVALUATION, SUMS_OF_SETTLING = 2, 11, 5
VECTOR = 24                  # bytes of a vector of a particle


@dataclass(frozen=True)
class ParticleWork:
    """An evaluation of a model with `particles` particles, `cells` layers and grid cells along a side.

    Parameters
    ----------
    wavenumber : highest of the resolved velocity, along each axis; 0 of a model without it.
    neighbors, radius : of pairs; 0 without them. skin : by which the halo is wider.
    iterations : of the solve.
    drift : rms distance by which particles move along z from one place to the next.
    evaluations : in a step. together : of these, at the same places.
    real : bytes of a number of grid and pairs. density : whether it is a state of its own.
    """

    particles: int
    cells: int
    wavenumber: int = 0
    neighbors: float = 0.0
    radius: float = 0.0
    skin: float = 0.0
    iterations: float = 0.0
    drift: float = 0.0
    evaluations: int = 1
    together: int = 1
    real: int = 4
    density: bool = False

    # ---- the busiest rank's share

    def planes(self, ranks: int) -> int:
        """Layers of the thickest slab."""
        return math.ceil(self.cells / ranks)

    def own(self, ranks: int) -> float:
        """Particles of the thickest slab."""
        return self.particles * self.planes(ranks) / self.cells

    def ghosts(self, ranks: int) -> float:
        """Particles of the slabs beside it that a rank sees."""
        return 2 * self.within(self.radius + self.skin) if ranks > 1 and self.neighbors else 0.0

    def pairs(self, ranks: int) -> float:
        """Pairs that a rank evaluates, each once.

        Of n neighbours half are counted with each particle. A face of the slab cuts pi r^4 rho^2 / 4 pairs an area
        (r the radius, rho particles a volume), which both sides evaluate: of a slab of thickness b that makes
        3 r / (8 b) more.
        """
        thickness = self.planes(ranks) * BOX_LENGTH / self.cells
        return self.own(ranks) * self.neighbors / 2 * (1 + (ranks > 1) * 3 * self.radius / (8 * thickness))

    def points(self, ranks: int) -> float:
        """Grid points that transforms work on: planes go in pairs."""
        return self.cells**2 * busiest_planes(self.cells, ranks)

    def modes(self, ranks: int) -> float:
        """Modes of a component: those of a rank are cut along ky."""
        if not self.wavenumber:
            return 0.0
        along = 2 * self.wavenumber + 1
        return along * math.ceil(along / ranks) * (self.wavenumber + 1)

    def settles(self, ranks: int) -> bool:
        """Whether particles change rank or order: for a list of pairs, or for the slabs of the grid."""
        return self.neighbors > 0 or self.wavenumber > 0 and ranks > 1

    def ghost_planes(self) -> int:
        """Planes that splines want of the neighbours, above and below a slab together."""
        return 3 + 2 * self.margin

    @property
    def margin(self) -> int:
        """Planes by which a particle may be outside its slab: half the skin."""
        return max(math.ceil(self.skin / 2 * self.cells / BOX_LENGTH - 1e-9), 1)

    # ---- bytes

    def transposed_bytes(self, components: float) -> float:
        """Bytes of the modes of components that change between columns and planes, over all ranks."""
        return components * self.cells * (2 * self.wavenumber + 1) * (self.wavenumber + 1) * 2 * self.real

    def ghost_plane_bytes(self, components: float) -> float:
        """Bytes of the ghost planes of components that a rank sends, up and down together."""
        return components * self.ghost_planes() * self.cells**2 * self.real

    @property
    def companions(self) -> tuple[float, float]:
        """Vectors and densities that settle beside the particles of a stage: of position and velocity at the start and
        at the end of a step, but for its first stage; where particles move once a step velocities alone."""
        if self.evaluations == self.together:
            return 1, self.density
        later = (self.evaluations - 1) / self.evaluations
        return 4 * later, 2 * later * self.density

    def settled_columns(self) -> float:
        """Columns that a settling sends: those of the particles, with their id, and companions."""
        return 3 + self.density + sum(self.companions)

    def settled_bytes(self) -> float:
        """Bytes of a particle that changes its rank."""
        vectors, densities = self.companions
        return 8 + VECTOR * (2 + vectors) + 8 * (self.density + densities)

    def movers(self) -> float:
        """Particles that leave a slab through its two faces between evaluations, of normal velocities."""
        return 2 * self.within(self.drift) / math.sqrt(2 * math.pi)

    def within(self, width: float) -> float:
        """Particles in a layer of that width."""
        return self.particles * width / BOX_LENGTH


def particle_work(scene: Scene) -> ParticleWork:
    """The work of a scene's own model."""
    tracers, model, settings = scene.tracers, scene.model, scene.simulation
    turbulence = expected_turbulence(scene)
    resolved, paired, highest = scene.resolves, "pairs" in model.reads, resolved_shells(scene)
    scheme, radius = settings.scheme, scene.interaction_radius
    # As far as the flow may carry a particle through the highest wave, where nothing is known of it.
    way = scheme.angle / highest
    if turbulence:
        way = turbulence.velocity_rms * rollout_step(scene)
    return ParticleWork(
        tracers.particles, tracers.planes,
        highest if resolved else 0,
        scene.neighbors if paired else 0.0, radius if paired else 0.0,
        settings.skin * radius if paired or resolved else 0.0, scheme.iterations if resolved else 0.0,
        way * scheme.at_a_place / scheme.evaluations, scheme.evaluations, scheme.at_a_place,
        4 if settings.precision == "float32" else 8, "density_rate" in model.gives)
