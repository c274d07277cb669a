"""Copies around transforms, with each compiled library."""

import numpy as np
import pytest

from eddies.kernels.copies import PlaneCopies
from tests.spectral import test_spectral_grid as transforms
from tests.validation.flows import make_grid


@pytest.mark.mpi(1, 3)
@pytest.mark.parametrize("cells, cutoff, precision, error", [
    (12, 3, "float64", 1e-13), (13, 4, "float32", 1e-5), (8, 2, "float32", 1e-5), (7, 3, "float64", 1e-13),
    (4, 1, "float64", 1e-13)])
def test_transforms_and_derivatives_are_those_of_numpy(comm, library, close, cells, cutoff, precision, error):
    """Odd and even numbers of planes, of cells and of modes; with few cells some ranks have few lines."""
    grid = make_grid(comm, cells, precision, cutoff)
    whole, own = transforms.noise(grid, 3)
    modes = grid.forward(own)
    close(modes, transforms.spectral_of(grid, whole), error, least=1e-2)

    def expand(packed):
        return [(grid.d_dx, packed[:3]), (grid.d_dy, packed[:3]), packed[3:], packed[:3]]

    axis = np.fft.fftfreq(cells, 1 / cells)
    k = np.stack(np.meshgrid(axis, axis, axis, indexing="ij")[::-1])
    spectrum = np.fft.fftn(whole, axes=(1, 2, 3)) * (np.abs(k) <= cutoff).all(axis=0)
    fields = np.fft.ifftn(np.concatenate([*(1j * each * spectrum for each in k), spectrum]), axes=(1, 2, 3)).real
    blocks = [values.reshape(12, -1).copy() for values in grid.blocks(modes, 12, expand, z_derivatives=3)]
    expected = fields[:, grid.decomposition.start : grid.decomposition.stop].reshape(12, -1)
    found = np.concatenate(blocks, axis=1)  # the points in another order
    order, place = np.argsort(found[9]), np.argsort(expected[9])
    close(found[:, order], expected[:, place], error)
    close(grid.backward(modes).reshape(3, -1), expected[9:], error)


def noise(seed, dtype, *shape):
    random = np.random.default_rng(seed)
    return (random.standard_normal(shape) + 1j * random.standard_normal(shape)).astype(dtype)


@pytest.mark.mpi(1)
def test_arrays_of_another_shape_are_refused(comm):
    grid = make_grid(comm, 12)
    for transform, shape in ((grid.forward, grid.spectral_shape), (grid.backward, grid.physical_shape)):
        with pytest.raises(ValueError, match="needed"):
            transform(np.zeros((1, *shape)))


def test_modes_that_are_not_conjugate_by_round_off_are_averaged(library):
    """Otherwise f would leak into g."""
    copies, block = PlaneCopies(8, 2, np.complex128), np.zeros((1, 2, 5, 3), complex)
    block[0, 0, 1, 0], block[0, 0, 4, 0] = 1 + 2j, 1.5 - 1j  # ky = 1 and -1 at kx = 0
    packed = copies.pack(copies.described_blocks([block]), slice(0, 2))[0, 0]
    assert packed[1, 0] == 1.25 + 1.5j and packed[4, 0] == 1.25 - 1.5j
