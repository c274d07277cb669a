import numpy as np
import pytest

from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.parallel.transpose import TransposeBuffers
from eddies.spectral.spectral_grid import SpectralGrid, regrid

# Round-off of a transform of this size; float32 has 2^29 times coarser numbers.
TOLERANCE = {"float64": 1e-14, "float32": 2e-6}


def spectral_of(grid, whole):
    """This rank's modes of a (c, n, n, n) array, by numpy."""
    n, K = grid.cells, grid.cutoff
    kept = np.r_[0 : K + 1, n - K : n]
    modes = np.fft.rfftn(whole, axes=(1, 2, 3))[:, kept][:, :, kept][..., : K + 1] / n**3
    own = slice(*grid.column_starts[grid.decomposition.rank :][:2])
    return modes[:, :, own]


def make_grid(comm, cells, **options):
    return SpectralGrid(SlabDecomposition(comm, 2 * np.pi, cells), **options)


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("cells", [7, 8, 15, 48])
def test_forward_and_backward_against_numpy(comm, cells, precision):
    grid = make_grid(comm, cells, precision=precision)
    own = slice(grid.decomposition.start, grid.decomposition.stop)
    whole = np.random.default_rng(1).standard_normal((3, cells, cells, cells))
    modes = grid.forward(whole[:, own])
    assert np.abs(modes - spectral_of(grid, whole)).max(initial=0) < TOLERANCE[precision]
    # A field without the dropped modes comes back; applying both again changes nothing.
    physical = grid.backward(modes)
    assert np.abs(grid.backward(grid.forward(physical)) - physical).max(initial=0) < 10 * TOLERANCE[precision]


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("cells", [48, 96, 120, 128, 192])
def test_what_is_transformed_across_lines_does_not_crowd_in_a_cache(comm, cells, precision):
    grid = make_grid(comm, cells, precision=precision)
    kept = grid.column_starts[grid.decomposition.rank + 1] - grid.column_starts[grid.decomposition.rank]
    columns = [grid.column_pass.plan("FORWARD", rows).plan for rows in grid.column_pass.rows(kept)]
    along_y = grid.plane_pass.plans("FORWARD", 1, 1).plans[0][1:]
    for plan, axis in [*((plan, 0) for plan in columns), *((plan, 1) for plan in along_y)]:
        for array in (plan.input_array, plan.output_array):
            # 512 bytes are eight lines of a cache of 64 sets.
            assert array.strides[axis] % 512


@pytest.mark.mpi(1, 2, 3)
def test_parseval(comm):
    grid = make_grid(comm, 9)
    noise = np.random.default_rng(comm.rank).standard_normal((1, *grid.physical_shape))
    band_limited = grid.backward(grid.forward(noise))
    modes = grid.forward(band_limited)
    assert grid.sum_modes(np.abs(modes[0]) ** 2) == pytest.approx(grid.mean(band_limited**2)[0], rel=1e-13)


@pytest.mark.mpi(1, 2, 3)
def test_batched_equals_single(comm):
    grid = make_grid(comm, 12)
    fields = np.random.default_rng(comm.rank).standard_normal((4, *grid.physical_shape))
    together = grid.forward(fields)
    assert all(np.array_equal(together[i], grid.forward(fields[i : i + 1])[0]) for i in range(4))
    back = grid.backward(together)
    assert all(np.array_equal(back[i], grid.backward(together[i : i + 1])[0]) for i in range(4))


@pytest.mark.mpi(1, 2, 3)
def test_quadratic_products_are_free_of_aliasing(comm):
    grid = make_grid(comm, 12)
    x, y, z = grid.coordinates()
    K = grid.cutoff
    square = np.broadcast_to(np.cos(K * x) * np.cos(K * z), grid.physical_shape)[None] ** 2
    modes = grid.forward(square)
    # cos^2 has modes 0 and 2K; the second is beyond the cutoff and must not fold back to n - 2K.
    modes[0, 0, grid.index[1].ravel() == 0, 0] -= 0.25
    assert np.abs(modes).max(initial=0) < 1e-15


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("cells", [8, 15])
def test_restriction_keeps_the_common_modes(comm, cells):
    fine, coarse = make_grid(comm, 24), make_grid(comm, cells, cutoff=3)
    whole = np.random.default_rng(2).standard_normal((2, 24, 24, 24))
    own = slice(fine.decomposition.start, fine.decomposition.stop)
    restricted = regrid(fine, coarse, fine.forward(whole[:, own]))
    kept = np.r_[0:4, 21:24]
    expected = (np.fft.rfftn(whole, axes=(1, 2, 3)) / 24**3)[:, kept][:, :, kept][..., :4]
    columns = slice(*coarse.column_starts[comm.rank :][:2])
    assert np.abs(restricted - expected[:, :, columns]).max(initial=0) < 1e-15
    # On the finer grid again they are what they were, and there is nothing else.
    back = regrid(coarse, fine, restricted)
    assert np.array_equal(regrid(fine, coarse, back), restricted)
    energies = [global_sum(comm, (grid.multiplicity * np.abs(modes)**2).sum())
                for grid, modes in ((fine, back), (coarse, restricted))]
    assert energies[0] == pytest.approx(energies[1], rel=1e-14)


@pytest.mark.mpi(1, 2)
def test_one_rank_sends_nothing(comm, monkeypatch):
    grid = make_grid(comm, 8)
    sent = []
    monkeypatch.setattr(TransposeBuffers, "_send", lambda *a, send=TransposeBuffers._send: sent.append(1) or send(*a))
    grid.backward(grid.forward(np.zeros((3, *grid.physical_shape))))
    # On more ranks a batch of three components travels in one message each way.
    assert len(sent) == (0 if comm.size == 1 else 2)


@pytest.mark.mpi(1, 2)
def test_what_stood_in_the_memory_of_a_transform_does_not_show(comm):
    # An odd plane out has no partner: what stands in its place, from the block before, must not show in the
    # last digits.
    grid = make_grid(comm, 15)
    field = np.random.default_rng(4).standard_normal((2, *grid.physical_shape))
    first = grid.forward(field)
    grid.backward(grid.forward(1e12 * field))
    assert np.array_equal(grid.forward(field), first)
    assert np.array_equal(grid.backward(first), grid.backward(first))


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("cells", [7, 8, 15])
def test_blocks_have_the_values_at_all_grid_points_once(comm, cells):
    grid = make_grid(comm, cells)
    modes = grid.forward(np.random.default_rng(comm.rank).standard_normal((3, *grid.physical_shape)))
    slopes = [grid.backward(1j * k * modes) for k in grid.wavevector]
    expected = np.concatenate([*slopes, grid.backward(modes)]).reshape(12, -1)

    def expand(packed):
        return [(grid.d_dx, packed[:3]), grid.d_dy * packed[:3], packed[3:], packed[:3]]

    found = [values.reshape(12, -1).copy() for values in grid.blocks(modes, 12, expand, z_derivatives=3)]
    found = np.concatenate([np.zeros((12, 0)), *found], axis=1)
    assert np.abs(np.sort(found) - np.sort(expected)).max(initial=0) < 1e-13


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("cells", [7, 8])
def test_a_product_of_fields_is_that_at_the_grid_points(comm, cells):
    grid = make_grid(comm, cells, cutoff=2)
    modes = grid.forward(np.random.default_rng(comm.rank).standard_normal((2, *grid.physical_shape)))

    def ratio(fields, out):
        out[0] = fields[0] / (2 + fields[1] ** 2)

    first, second = grid.backward(modes)
    found = grid.multiply(modes, ratio, 1, fields=2)
    assert np.abs(found - grid.forward((first / (2 + second**2))[None])).max(initial=0) < 1e-14
