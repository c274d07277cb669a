import numpy as np
import pytest

from eddies.parallel.halo import HaloError
from eddies.parallel.plane_halo import PlaneHalo
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition


@pytest.mark.mpi(1, 2, 3)
def test_padded_planes_are_those_of_the_periodic_array(comm):
    slab = SlabDecomposition(comm, 1.0, 10)
    whole = np.random.default_rng(5).standard_normal((3, 10, 2))
    parts = PlaneHalo(slab, 2, 3).forward(whole[:, slab.start : slab.stop])
    padded = np.concatenate(parts, axis=1)
    assert np.array_equal(padded, whole[:, np.arange(slab.start - 2, slab.stop + 3) % 10])


@pytest.mark.mpi(1, 2, 3)
def test_adjoint_is_the_transpose(comm):
    slab, random = SlabDecomposition(comm, 1.0, 10), np.random.default_rng(comm.rank)
    halo = PlaneHalo(slab, 2, 3)
    planes, parts = random.standard_normal((3, slab.count, 4)), halo.parts(np.empty((3, slab.count, 4)))
    for part in parts:
        part[...] = random.standard_normal(part.shape)
    forward = sum(np.sum(part * weight) for part, weight in zip(halo.forward(planes), parts))
    found, expected = global_sum(comm, np.array([forward, np.sum(planes * halo.adjoint(parts))]))
    assert found == pytest.approx(expected, rel=1e-12)


@pytest.mark.mpi(3)
def test_slabs_thinner_than_the_ghost_planes_are_refused(comm):
    with pytest.raises(HaloError, match="at most 2 ranks"):
        PlaneHalo(SlabDecomposition(comm, 1.0, 8), 3, 4)
