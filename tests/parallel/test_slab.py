import numpy as np
import pytest

from eddies.parallel.slab import SlabDecomposition, block_starts


@pytest.mark.parametrize("total, parts", [(10, 3), (2, 3), (0, 2), (7, 7)])
def test_blocks_are_contiguous_complete_and_differ_by_at_most_one(total, parts):
    starts = block_starts(total, parts)
    sizes = np.diff(starts)
    assert starts[0] == 0 and starts[-1] == total
    assert sizes.max() - sizes.min() <= 1


@pytest.mark.mpi(1, 2, 3)
def test_every_coordinate_has_the_owner_whose_bounds_hold_it(comm):
    slab = SlabDecomposition(comm, 2 * np.pi, 7)
    z = np.random.default_rng(1).uniform(0, slab.length, 1000)
    mine = slab.owner_of(z) == comm.rank
    assert np.array_equal(mine, (z >= slab.lower) & (z < slab.upper))
    assert slab.owner_of(np.nextafter(slab.length, 0)) == comm.size - 1
    assert slab.owner_of(slab.lower) == comm.rank
