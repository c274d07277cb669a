import numpy as np
import pytest

from eddies.spectral.spectral_grid import regrid
from tests.parallel.counting import CountingComm
from tests.validation.flows import make_grid

# Round-off of a transform of this size; float32 has 2^29 times coarser numbers.
TOLERANCE = {"float64": 1e-14, "float32": 2e-6}


def spectral_of(grid, whole):
    """This rank's modes of an array (c, n, n, n), by numpy."""
    n, K = whole.shape[1], grid.cutoff
    kept = np.r_[0 : K + 1, n - K : n]
    modes = np.fft.rfftn(whole, axes=(1, 2, 3))[:, kept][:, :, kept][..., : K + 1] / n**3
    own = slice(*grid.column_starts[grid.decomposition.rank :][:2])
    return modes[:, :, own]


def noise(grid, components, seed=1):
    """A field on all points, and this rank's planes of it."""
    whole = np.random.default_rng(seed).standard_normal((components, grid.cells, grid.cells, grid.cells))
    return whole, whole[:, grid.decomposition.start : grid.decomposition.stop]


def largest(array):
    return np.abs(array).max(initial=0)


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("cells, precision", [(15, "float64"), (48, "float32")])
def test_forward_and_backward_against_numpy(comm, cells, precision):
    grid = make_grid(comm, cells, precision)
    whole, own = noise(grid, 3)
    modes = grid.forward(own)
    assert largest(modes - spectral_of(grid, whole)) < TOLERANCE[precision]
    # A field without the dropped modes comes back; applying both again changes nothing.
    physical = grid.backward(modes)
    assert largest(grid.backward(grid.forward(physical)) - physical) < 10 * TOLERANCE[precision]
    # Several components at once give the same bits as one after the other.
    assert all(np.array_equal(modes[i], grid.forward(own[i : i + 1])[0]) for i in range(3))
    assert all(np.array_equal(physical[i], grid.backward(modes[i : i + 1])[0]) for i in range(3))
    power = grid.mean(physical**2).sum()  # Parseval
    assert grid.sum_modes((np.abs(modes) ** 2).sum(axis=0)) == pytest.approx(power, rel=10 * TOLERANCE[precision])


@pytest.mark.mpi(2)
@pytest.mark.parametrize("cells, precision", [(48, "float32"), (128, "float64")])
def test_lines_that_are_transformed_across_do_not_crowd_a_cache(comm, cells, precision):
    grid = make_grid(comm, cells, precision)
    columns = [grid.column_pass.plan("FORWARD", rows).plan for rows in grid.column_pass.rows(grid.spectral_shape[1])]
    along_y = grid.plane_pass.plans("FORWARD", 1, slice(0, 2)).plans[0][1:]
    for plan, axis in [*((plan, 0) for plan in columns), *((plan, 1) for plan in along_y)]:
        for array in (plan.input_array, plan.output_array):
            # 512 bytes are eight lines of a cache of 64 sets.
            assert array.strides[axis] % 512


@pytest.mark.mpi(1, 3)
def test_quadratic_products_are_free_of_aliasing(comm):
    grid = make_grid(comm, 12)
    x, y, z = grid.coordinates()
    K = grid.cutoff
    square = np.broadcast_to(np.cos(K * x) * np.cos(K * z), grid.physical_shape)[None] ** 2
    modes = grid.forward(square)
    # cos^2 has modes 0 and 2K; the second is beyond the cutoff and must not fold back to n - 2K.
    modes[0, 0, grid.index[1].ravel() == 0, 0] -= 0.25
    assert largest(modes) < 1e-15


@pytest.mark.mpi(1, 3)
@pytest.mark.parametrize("cells", [8, 15])
def test_restriction_keeps_the_common_modes(comm, cells):
    fine, coarse = make_grid(comm, 24), make_grid(comm, cells, cutoff=3)
    whole, own = noise(fine, 2)
    restricted = regrid(fine, coarse, fine.forward(own))
    assert largest(restricted - spectral_of(coarse, whole)) < 1e-15
    # Back on the finer grid they are unchanged, and all other modes are zero.
    back = regrid(coarse, fine, restricted)
    assert np.array_equal(regrid(fine, coarse, back), restricted)
    assert fine.sum_modes(np.abs(back) ** 2) == pytest.approx(coarse.sum_modes(np.abs(restricted) ** 2), rel=1e-14)


@pytest.mark.mpi(1, 2)
def test_a_batch_of_components_is_one_message_each_way(comm):
    counting = CountingComm(comm)
    grid = make_grid(counting, 8)
    grid.backward(grid.forward(np.zeros((3, *grid.physical_shape))))
    assert counting.sent == ([] if comm.size == 1 else ["Alltoallv"] * 2)


@pytest.mark.mpi(2)
def test_earlier_contents_of_the_memory_of_a_transform_do_not_show(comm):
    # A last odd plane has no partner: the contents of that place must not change the last digits.
    grid = make_grid(comm, 15)
    _, field = noise(grid, 2)
    first = grid.forward(field)
    grid.backward(grid.forward(1e12 * field))
    assert np.array_equal(grid.forward(field), first)
    assert np.array_equal(grid.backward(first), grid.backward(first))


@pytest.mark.mpi(1, 3)
@pytest.mark.parametrize("cells", [7, 8])
def test_a_product_of_fields_is_that_at_the_grid_points(comm, cells):
    grid = make_grid(comm, cells, cutoff=2)
    modes = grid.forward(noise(grid, 2)[1])

    def ratio(fields, out):
        out[0] = fields[0] / (2 + fields[1] ** 2)

    first, second = grid.backward(modes)
    quotient = grid.multiply(modes, ratio, 1, fields=2)
    assert largest(quotient - grid.forward((first / (2 + second**2))[None])) < 1e-14
    second_moments = grid.squares(np.concatenate([modes, modes[:1]]))
    assert largest(second_moments[3] - grid.forward((first * second)[None])[0]) < 1e-14


@pytest.mark.mpi(1, 2)
def test_blocks_have_the_value_of_each_grid_point_once(comm):
    grid = make_grid(comm, 15)  # an odd number of planes on one rank and on the first of two
    modes = grid.forward(noise(grid, 2)[1])
    values = np.concatenate([block.reshape(2, -1).copy() for block in grid.blocks(modes, fields=2)], axis=1)
    assert np.allclose(np.sort(values), np.sort(grid.backward(modes).reshape(2, -1)), rtol=0, atol=1e-13)
