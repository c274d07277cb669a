import math

import numpy as np
import pytest
import torch

from eddies.parallel.halo import HaloError
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.exchanges import with_ghosts
from eddies.particles.neighborhood import Neighborhood, NeighborList, at_home
from eddies.particles.particle_set import ParticleSet
from eddies.particles.periodic_box import PeriodicBox
from tests.particles.configurations import LENGTH, positions


def particles_at(comm, heights):
    """Particles of this rank, one at each z."""
    count = len(heights)
    position = torch.tensor([[1.0, 1.0, z] for z in heights], dtype=torch.float64).reshape(count, 3)
    return ParticleSet(torch.arange(count) + 10 * comm.rank, position, torch.zeros_like(position), torch.ones(count))


@pytest.mark.mpi(2, 3)
@pytest.mark.parametrize("strayed, refused", [(0.29, False), (0.35, True)])
def test_particles_that_enter_a_slab_from_both_sides_must_not_meet(comm, strayed, refused):
    """Ranks do not exchange these two strayed particles. At 0.35 they are within the cutoff, so their pair would be
    missing."""
    slab = SlabDecomposition(comm, LENGTH, 24)
    cutoff = LENGTH / comm.size - 0.6
    heights = [slab.upper + strayed] if comm.rank == 0 else []
    heights += [slab.lower - strayed] if comm.rank == 2 % comm.size else []
    neighborhood = Neighborhood(slab, cutoff, 0.0)
    assert (LENGTH / comm.size - 2 * strayed < cutoff) == refused
    if refused:
        with pytest.raises(HaloError):
            neighborhood.update(particles_at(comm, heights))
    else:
        neighborhood.update(particles_at(comm, heights))


@pytest.mark.mpi(2)
def test_particles_that_approach_across_a_face_by_less_than_the_skin_become_neighbours(comm):
    slab, cutoff, skin = SlabDecomposition(comm, LENGTH, 24), 1.0, 0.4
    neighborhood = Neighborhood(slab, cutoff, skin)
    particles = particles_at(comm, [slab.upper - 1.18 if comm.rank == 0 else slab.lower + 0.02])  # 1.2 apart, then 0.84
    neighborhood.update(particles)
    particles.position[:, 2] += 0.18 if comm.rank == 0 else -0.18
    neighborhood.update(particles)
    position = with_ghosts(neighborhood.halo, particles.position, positions=True)
    assert neighborhood.builds == 1 and len(neighborhood.neighbors.pairs(position[:1], position).distance) == 1


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("z, complaint", [(-0.7 * LENGTH, "outside its slab"), (math.nan, "not finite")])
def test_all_ranks_name_a_particle_far_from_its_slab(comm, z, complaint):
    """Below the slab of the second rank by more than the length of the box. One rank holds all periods."""
    slab = SlabDecomposition(comm, LENGTH, 24)
    below = z if comm.size > 1 else z - LENGTH
    heights = [slab.upper - 0.1, below if comm.rank == comm.size - 1 else slab.lower]
    neighborhood, particles = Neighborhood(slab, 1.0, 0.0), particles_at(comm, heights)
    if comm.size == 1 and math.isfinite(z):
        neighborhood.update(particles)
        return
    last = comm.size - 1
    with pytest.raises(HaloError, match=f"rank {last}, particle {10 * last + 1}: .*{complaint}"):
        neighborhood.update(particles)


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("unit, cells", [(1, 4), (2**50, 4), (2**56, 1)])
def test_particles_settle_in_order_of_cells_and_ids(comm, unit, cells):
    """Ids may be so large that cell and id fit one integer only with fewer cells."""
    slab, random = SlabDecomposition(comm, 1.0, 8), np.random.default_rng(3)
    position, ids = random.random((60, 3)), unit * random.permutation(60)
    own = slice(comm.rank, None, comm.size)
    found = at_home(slab, {"id": torch.from_numpy(ids[own]), "position": torch.from_numpy(position[own])}, 1 / 4)
    here = slab.owner_of(position[:, 2]) == comm.rank
    x, y, z = (position[here].T * cells).astype(int)
    assert np.array_equal(found["id"], ids[here][np.lexsort((ids[here], x, y, z))])
    nothing = at_home(slab, {"id": torch.empty(0, dtype=torch.int64), "position": torch.empty(0, 3)}, 1 / 4)
    assert len(nothing["id"]) == 0


# ---- the list alone


def test_blocks_cover_all_rows_once_with_about_as_many_pairs():
    position, neighbors = positions("uneven", 300), NeighborList(PeriodicBox(LENGTH), 0.8, 0.0)
    neighbors.build(position, position, exclude_self=True)
    blocks = list(neighbors.blocks(100))
    assert [row for block in blocks for row in range(block.start, block.stop)] == list(range(300))
    most = int(neighbors.offsets.diff().max())
    sizes = [int(neighbors.offsets[block.stop] - neighbors.offsets[block.start]) for block in blocks]
    assert len(blocks) > 10 and max(sizes) <= 100 + most


@pytest.mark.parametrize("cutoff, skin", [(0.0, 0.1), (1.0, -0.1), (3.0, 0.2)])
def test_impossible_radii_are_refused(cutoff, skin):
    with pytest.raises(ValueError, match="half the box"):
        NeighborList(PeriodicBox(LENGTH), cutoff, skin)


def test_positions_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match="not finite"):
        NeighborList(PeriodicBox(LENGTH), 1.0, 0.0).build(torch.full((2, 3), torch.nan), torch.zeros(2, 3), True)
