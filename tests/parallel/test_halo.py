"""Halos of particles and of planes around slabs."""

import numpy as np
import pytest

from eddies.parallel.halo import HaloError, HaloExchange, PlaneHalo
from eddies.parallel.migration import migrate
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition

LENGTH = 2 * np.pi
WIDTH = 0.8


def slab_particles(comm, total=300, squeeze=1.0):
    random = np.random.default_rng(4)
    position = random.uniform(0, LENGTH, (total, 3))
    position[:, 2] *= squeeze
    own = np.arange(total) % comm.size == comm.rank
    slab = SlabDecomposition(comm, LENGTH, 17)
    return slab, migrate(slab, {"id": np.arange(total)[own], "position": position[own]}), position


@pytest.mark.mpi(2, 3)
@pytest.mark.parametrize("squeeze", [1.0, 0.2], ids=["everywhere", "on one rank"])
def test_ghosts_are_exactly_the_images_within_the_width(comm, squeeze):
    slab, particles, position = slab_particles(comm, squeeze=squeeze)
    halo = HaloExchange(slab, particles["position"], WIDTH)
    expected = []
    for shift in (-LENGTH, 0.0, LENGTH):
        z = position[:, 2] + shift
        near = ((z >= slab.lower - WIDTH) & (z < slab.lower)) | ((z >= slab.upper) & (z < slab.upper + WIDTH))
        expected += [(i, z[i]) for i in np.flatnonzero(near)]
    ghosts = zip(halo.forward(particles["id"]), halo.forward_positions(particles["position"])[:, 2])
    assert halo.count == len(expected) and np.allclose(sorted(ghosts), sorted(expected), atol=1e-12)


@pytest.mark.mpi(2, 3)
@pytest.mark.parametrize("squeeze, width", [(0.2, WIDTH), (1.0, 4.9 * LENGTH / 17)],
                         ids=["on one rank", "seen from both sides"])
def test_adjoint_identity(comm, squeeze, width):
    """The thinnest slab is 5/17 of the box on three ranks and 8/17 on two. With the last width many particles have an
    image on both sides, whose gradients are added."""
    slab, particles, _ = slab_particles(comm, squeeze=squeeze)
    halo = HaloExchange(slab, particles["position"], width)
    random = np.random.default_rng(comm.rank)
    x, y = random.standard_normal((len(particles["id"]), 2)), random.standard_normal((halo.count, 2))
    left, right = global_sum(comm, np.array([np.vdot(halo.forward(x), y), np.vdot(x, halo.adjoint(y))]))
    assert left == pytest.approx(right, rel=1e-13, abs=1e-13)


@pytest.mark.mpi(1, 2, 3)
def test_ghost_planes_are_those_of_the_periodic_array(comm):
    slab = SlabDecomposition(comm, 1.0, 10)
    whole = np.random.default_rng(5).standard_normal((3, 10, 2))
    padded = np.concatenate(PlaneHalo(slab, 2, 3).forward(whole[:, slab.start : slab.stop]), axis=1)
    assert np.array_equal(padded, whole[:, np.arange(slab.start - 2, slab.stop + 3) % 10])


@pytest.mark.mpi(1, 2, 3)
def test_adjoint_of_ghost_planes_is_the_transpose(comm):
    slab, random = SlabDecomposition(comm, 1.0, 10), np.random.default_rng(comm.rank)
    halo = PlaneHalo(slab, 2, 3)
    planes, parts = random.standard_normal((3, slab.count, 4)), halo.parts(np.empty((3, slab.count, 4)))
    for part in parts:
        part[...] = random.standard_normal(part.shape)
    forward = sum(np.sum(part * weight) for part, weight in zip(halo.forward(planes), parts))
    left, right = global_sum(comm, np.array([forward, np.sum(planes * halo.adjoint(parts))]))
    assert left == pytest.approx(right, rel=1e-12)


@pytest.mark.mpi(3)
def test_slabs_thinner_than_a_halo_are_refused_with_the_usable_ranks(comm):
    slab = SlabDecomposition(comm, LENGTH, 8)
    with pytest.raises(HaloError, match="at most 2 ranks"):
        HaloExchange(slab, np.empty((0, 3)), 4 * slab.spacing)
    with pytest.raises(HaloError, match="at most 2 ranks"):
        PlaneHalo(slab, 3, 4)
    HaloExchange(slab, np.empty((0, 3)), 2 * slab.spacing)
