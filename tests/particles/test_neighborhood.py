import math

import pytest
import torch

from eddies.parallel.halo import HaloError
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.neighborhood import Neighborhood
from eddies.particles.particle_set import ParticleSet
from tests.particles.configurations import LENGTH


def particles_at(comm, heights):
    """This rank's particles, one at each z."""
    count = len(heights)
    position = torch.tensor([[1.0, 1.0, z] for z in heights], dtype=torch.float64).reshape(count, 3)
    return ParticleSet(torch.arange(count) + 10 * comm.rank, position, torch.zeros_like(position), torch.ones(count))


@pytest.mark.mpi(2, 3)
@pytest.mark.parametrize("strayed, refused", [(0.29, False), (0.35, True)])
def test_particles_that_stray_into_one_slab_from_both_sides_are_refused_where_they_would_see_each_other(
        comm, strayed, refused):
    """Through the second slab, whose owner alone sees both: at 0.35 they would be within the cutoff, but no pair."""
    slab = SlabDecomposition(comm, LENGTH, 24)
    cutoff = LENGTH / comm.size - 0.6
    heights = [slab.upper + strayed] if comm.rank == 0 else []
    heights += [slab.lower - strayed] if comm.rank == 2 % comm.size else []
    neighborhood = Neighborhood(slab, LENGTH, cutoff, 0.0)
    assert (LENGTH / comm.size - 2 * strayed < cutoff) == refused
    if refused:
        with pytest.raises(HaloError, match="thinner than the halo"):
            neighborhood.update(particles_at(comm, heights))
    else:
        neighborhood.update(particles_at(comm, heights))


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("z, complaint", [(-0.7 * LENGTH, "farther outside its slab than the box is long"),
                                          (math.nan, "not finite")])
def test_a_particle_that_is_nowhere_near_its_slab_is_named_by_all_ranks(comm, z, complaint):
    """Less than a length below the box, but more below the slab of the second rank. One rank has all periods."""
    slab = SlabDecomposition(comm, LENGTH, 24)
    below = z if comm.size > 1 else z - LENGTH
    heights = [slab.upper - 0.1, below if comm.rank == comm.size - 1 else slab.lower]
    neighborhood, particles = Neighborhood(slab, LENGTH, 1.0, 0.0), particles_at(comm, heights)
    if comm.size == 1 and math.isfinite(z):
        neighborhood.update(particles)
        return
    with pytest.raises(HaloError) as told:
        neighborhood.update(particles)
    last = comm.size - 1
    assert f"within the step, rank {last}, particle {10 * last + 1}: {complaint}" in str(told.value)
