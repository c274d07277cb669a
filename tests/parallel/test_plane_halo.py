import numpy as np
import pytest

from eddies.parallel.halo import HaloError
from eddies.parallel.plane_halo import PlaneHalo
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition


@pytest.mark.mpi(1, 2, 3)
def test_padded_planes_are_those_of_the_periodic_array(comm):
    slab = SlabDecomposition(comm, 1.0, 10)
    whole = np.random.default_rng(5).standard_normal((10, 2))
    padded = PlaneHalo(slab, 2, 3).forward(whole[slab.start : slab.stop])
    assert np.array_equal(padded, whole[np.arange(slab.start - 2, slab.stop + 3) % 10])


@pytest.mark.mpi(1, 2, 3)
def test_adjoint_is_the_transpose(comm):
    slab, random = SlabDecomposition(comm, 1.0, 10), np.random.default_rng(comm.rank)
    halo = PlaneHalo(slab, 2, 3)
    planes, padded = random.standard_normal((slab.count, 4)), random.standard_normal((slab.count + 5, 4))
    products = np.array([np.sum(halo.forward(planes) * padded), np.sum(planes * halo.adjoint(padded))])
    found, expected = global_sum(comm, products)
    assert found == pytest.approx(expected, rel=1e-12)


@pytest.mark.mpi(3)
def test_slabs_thinner_than_the_ghost_planes_are_refused(comm):
    with pytest.raises(HaloError, match="at most 2 ranks"):
        PlaneHalo(SlabDecomposition(comm, 1.0, 8), 3, 4)
