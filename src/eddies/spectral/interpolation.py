"""Fields at arbitrary points by B-splines whose coefficients are exact in Fourier space."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from eddies.kernels.library import library
from eddies.kernels.splines import MisplacedPoint, PaddedPlanes, Splines
from eddies.parallel.halo import HaloError
from eddies.parallel.plane_halo import PlaneHalo
from eddies.spectral.spectral_grid import SpectralGrid

ORDERS = {"cubic": 3, "quintic": 5}


class SplineInterpolation:
    """Tensor-product B-splines through the grid values of band-limited fields.

    The spline coefficients follow from dividing each Fourier mode by the transform of the B-spline, so they are those
    of the interpolating spline exactly (Hinsberg et al. 2012). The error of a mode k is of order (k dx)^(degree + 1).

    Parameters
    ----------
    grid : where the field is sampled.
    kind : "cubic" or "quintic".
    margin : planes by which a point may lie outside this rank's slab, as a predicted position does.
    """

    def __init__(self, grid: SpectralGrid, kind: str, margin: int = 1) -> None:
        self.grid, self.degree = grid, ORDERS[kind]
        reach = (self.degree - 1) // 2
        slab = grid.decomposition
        self._halo = PlaneHalo(slab, reach + margin, reach + 1 + margin)
        self._padded = PaddedPlanes(grid.cells, slab.spacing, slab.start - self._halo.below,
                                    slab.count + self._halo.below + self._halo.above)
        angle = 2 * np.pi / grid.cells
        transforms = [_spline_transform(self.degree, angle * axis) for axis in grid.index]
        #: by which each mode is multiplied to make it one of spline coefficients
        self.inverse = (1.0 / (transforms[0] * transforms[1] * transforms[2])).astype(grid.real)

    def coefficients(self, spectral: np.ndarray) -> list[np.ndarray]:
        """Spline coefficients of fields (c, kz, ky, kx), as `at` wants them."""
        return self.with_ghosts(self.grid.backward(spectral * self.inverse))

    def with_ghosts(self, planes: np.ndarray) -> list[np.ndarray]:
        """Planes (c, z_local, y, x) of coefficients between those of the neighbours, as parts."""
        return self._halo.forward(planes)

    def at(self, coefficients: Sequence[np.ndarray], positions: np.ndarray) -> np.ndarray:
        """Values (n, c) at positions (n, 3), x and y anywhere, z within the slab and the margin (periodically).

        Errors are those of `around`."""
        return self.around(positions).at(coefficients)

    def around(self, positions: np.ndarray) -> Splines:
        """The splines around positions (n, 3), for values, slopes and sums of splines at the same points.

        Raises HaloError where one is outside the slab and the margin, ValueError where one is not finite.
        """
        try:
            return Splines(library(), self.degree, positions, self._padded)
        except MisplacedPoint as error:
            position = np.asarray(positions)[error.number]
        if not np.isfinite(position).all():
            raise ValueError(f"interpolation: position {position} is not finite")
        raise HaloError("a particle moves farther out of its slab in one step than the ghost planes reach: "
                        "lower step, courant or max_step")

    def spread(self, values: np.ndarray, splines: Splines) -> np.ndarray:
        """The transpose of `with_ghosts` and values at points: planes (c, z_local, y, x) of values (n, c) times the
        splines around them."""
        parts = self._halo.parts(np.zeros((values.shape[1], *self.grid.physical_shape), self.grid.real))
        splines.spread(values, parts)
        return self._halo.adjoint(parts)


def _spline_transform(degree: int, angle: np.ndarray) -> np.ndarray:
    """Discrete Fourier transform of the integer samples of the cubic or quintic B-spline."""
    if degree == 3:
        return (2 + np.cos(angle)) / 3
    return (33 + 26 * np.cos(angle) + np.cos(2 * angle)) / 60
