"""The ranks that a scene can use are those that the parts of a run accept."""

from contextlib import nullcontext

import pytest

from eddies.scene.scene import load_scene
from eddies.workflows.foreseen.numbers import estimate
from eddies.workflows.foreseen.ranks import ALLOWED_VELOCITY, PEAK_VELOCITY, most_ranks
from tests.small_scene import TINY, one_model


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("override, most", [
    ("kernel.neighbors=100", 3), ("kernel.neighbors=200", 2), ("simulation.skin=1", 2)])
def test_most_ranks_is_what_the_parts_accept(comm, override, most):
    from eddies.parallel.halo import HaloError, require_thick_slabs
    from eddies.parallel.slab import SlabDecomposition
    from eddies.scene.scene import BOX_LENGTH
    from eddies.spectral.interpolation import SplineInterpolation
    from eddies.spectral.spectral_grid import SpectralGrid
    scene = load_scene(TINY, [override])
    fields, particles = (SlabDecomposition(comm, BOX_LENGTH, planes)
                         for planes in (scene.tracers.cells, scene.tracers.planes))
    assert min(most_ranks(scene).values()) == most
    SplineInterpolation(SpectralGrid(fields), "quintic")
    SplineInterpolation(SpectralGrid(particles), "cubic")
    with nullcontext() if comm.size <= most else pytest.raises(HaloError):
        require_thick_slabs(fields, scene.kernel_support)
        require_thick_slabs(particles, scene.interaction_radius * (1 + scene.simulation.skin))


@pytest.mark.parametrize("overrides, planes", [([], 4), (["simulation.step=0.1"], 3),
                                               (["simulation.step=0.1", "time.courant=2.5"], 5)])
def test_a_coarse_grid_has_ghost_planes_for_its_courant_number(overrides, planes):
    """A search for the step begins with 1.4, the scene has 1."""
    scene = load_scene("hit-small", overrides).variant["grid-32"]
    assert most_ranks(scene)["ghost planes of the coarse grid"] == 32 // planes


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("frames, thick, planes", [(2, 3, 6), (12, 1, 2)])
def test_ranks_for_horizons_are_those_that_the_grid_and_the_particles_accept(comm, frames, thick, planes):
    """The grid that the training builds, and the halo of a particle that moved as far as expected."""
    import torch

    from eddies.parallel.halo import HaloError
    from eddies.parallel.slab import SlabDecomposition
    from eddies.particles.neighborhood import Neighborhood
    from eddies.particles.particle_set import ParticleSet
    from eddies.particles.resolved_velocity import ResolvedVelocity
    from eddies.scene.scene import BOX_LENGTH
    from tests.particles.configurations import FLOW

    def accepted(build):
        try:
            build()
        except HaloError:
            return False
        return True

    scene = load_scene(TINY, ["training.horizons.steps=5", f"training.horizons.frames=[1, {frames}]"])
    limits = most_ranks(scene)
    by_reach, = (ranks for reason, ranks in limits.items() if "reach" in reason and "horizons" in reason)
    by_grid = limits["ghost planes of the grid in the training through horizons"]
    assert (by_reach, by_grid) == (thick, planes)
    speed, tracers = estimate(scene).turbulence.velocity_rms, scene.tracers
    slab, support = SlabDecomposition(comm, BOX_LENGTH, tracers.planes), scene.kernel_support
    time = frames * tracers.frame_interval
    drift = ALLOWED_VELOCITY * speed * time
    assert accepted(lambda: ResolvedVelocity.on_slabs(slab, FLOW.scales, drift)) == (comm.size <= by_grid)
    far = torch.tensor([[1.0, 1.0, slab.upper + PEAK_VELOCITY * speed * time]], dtype=torch.float64)
    particles = ParticleSet(torch.tensor([comm.rank]), far, torch.zeros_like(far), torch.ones(1))
    around = Neighborhood(slab, support, 0.0)
    assert accepted(lambda: around.update(particles)) == (comm.size <= by_reach)


def test_ghost_planes_limit_the_ranks():
    fields = {planes: most_ranks(load_scene(TINY, [f"tracers.field_cells={planes}"])) for planes in (11, 12)}
    assert [limits["ghost planes of the filtered fields"] for limits in fields.values()] == [2, 3]
    # A slab needs two ghost planes for the splines, and more for particles that moved by half the skin.
    assert fields[12]["ghost planes of the resolved velocity"] == 20 // 3
    for overrides, ghosts in ((["simulation.step=0.2"], 3), (["simulation.skin=1"], 4)):
        assert most_ranks(load_scene(TINY, overrides))["ghost planes of the resolved velocity"] == 20 // ghosts
    assert "ghost planes of the resolved velocity" not in most_ranks(load_scene(TINY, ["model.preset=paper"]))
    coarse = ["model.preset=paper", "simulation.method=eulerian", "eulerian.cells=24"]
    for first, most in (("flow", None), ("particles", 20 // 3)):
        limits = most_ranks(load_scene(TINY, [*coarse, f"eulerian.start={first}"]))
        assert limits.get("ghost planes of the resolved velocity") == most


def test_what_no_term_reads_limits_no_ranks():
    fast = ["training.horizons.steps=5", "training.horizons.frames=[12]"]
    limits = {preset: most_ranks(load_scene(TINY, [*fast, f"model.preset={preset}"]))
              for preset in ("resolved + pairs", "resolved", "transport-velocity")}
    found = {preset: {word for word in ("reach", "resolved") if any(word in reason for reason in reasons)}
             for preset, reasons in limits.items()}
    assert found == {"resolved": {"resolved"}, "transport-velocity": {"reach"},
                     "resolved + pairs": {"reach", "resolved"}}
    for changes in ([], ["training.horizons.steps=5", "model.path=runs/other"]):
        limits = most_ranks(one_model("hit-small", changes))
        assert min(limits.values()) == 12 and not any("horizons" in reason for reason in limits)
