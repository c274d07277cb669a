import numpy as np
import pytest

from eddies.parallel.slab import SlabDecomposition
from eddies.parallel.transpose import TransposeBuffers
from eddies.spectral.spectral_grid import SpectralGrid, restrict

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
@pytest.mark.parametrize("cells", [7, 8, 15])
def test_forward_and_backward_against_numpy(comm, cells, precision):
    grid = make_grid(comm, cells, precision=precision)
    own = slice(grid.decomposition.start, grid.decomposition.stop)
    whole = np.random.default_rng(1).standard_normal((3, cells, cells, cells))
    modes = grid.forward(whole[:, own])
    assert np.abs(modes - spectral_of(grid, whole)).max(initial=0) < TOLERANCE[precision]
    # A field without the dropped modes comes back; applying both again changes nothing.
    physical = grid.backward(modes)
    assert np.abs(grid.backward(grid.forward(physical)) - physical).max(initial=0) < 10 * TOLERANCE[precision]


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
    restricted = restrict(fine, coarse, fine.forward(whole[:, own]))
    kept = np.r_[0:4, 21:24]
    expected = (np.fft.rfftn(whole, axes=(1, 2, 3)) / 24**3)[:, kept][:, :, kept][..., :4]
    columns = slice(*coarse.column_starts[comm.rank :][:2])
    assert np.abs(restricted - expected[:, :, columns]).max(initial=0) < 1e-15


@pytest.mark.mpi(1, 2)
def test_one_rank_sends_nothing(comm, monkeypatch):
    grid = make_grid(comm, 8)
    sent = []
    monkeypatch.setattr(TransposeBuffers, "_send", lambda *a, send=TransposeBuffers._send: sent.append(1) or send(*a))
    grid.backward(grid.forward(np.zeros((3, *grid.physical_shape))))
    # On more ranks a batch of three components travels in one message each way.
    assert len(sent) == (0 if comm.size == 1 else 2)


@pytest.mark.mpi(1)
def test_a_block_of_planes_leaves_nothing_for_the_next(comm):
    # An odd plane out has no partner: what stands in its place, from the block before, must not show in the
    # last digits.
    grid = make_grid(comm, 15)
    field = np.random.default_rng(4).standard_normal((2, *grid.physical_shape))
    first = grid.plane_pass.to_modes(field[:, -1:])
    grid.plane_pass.to_modes(1e12 * field[:, -3:-1])
    assert np.array_equal(grid.plane_pass.to_modes(field[:, -1:]), first)
