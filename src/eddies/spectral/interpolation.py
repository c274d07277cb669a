"""B-spline interpolation of fields at arbitrary points, with coefficients that are exact in Fourier space."""

from collections.abc import Sequence

import numpy as np

from eddies.kernels.splines import MisplacedPoint, Splines
from eddies.parallel.halo import HaloError, PlaneHalo, most_slabs, planes_within
from eddies.spectral.spectral_grid import SpectralGrid

ORDERS = {"cubic": 3, "quintic": 5}


class SplineInterpolation:
    """Tensor-product B-splines through the grid values of band-limited fields.

    Each Fourier mode is divided by the transform of the B-spline. This gives the coefficients of the interpolating
    spline exactly (Hinsberg et al. 2012). The error of a mode k is of order (k dx)^(degree + 1).

    Parameters
    ----------
    grid : grid on which the field is sampled.
    kind : "cubic" or "quintic".
    margin : number of planes by which a point may lie outside this rank's slab.
    """

    def __init__(self, grid: SpectralGrid, kind: str, margin: int = 1) -> None:
        self.grid, self.degree = grid, ORDERS[kind]
        slab = grid.decomposition
        self._halo = PlaneHalo(slab, *ghost_planes(kind, margin))
        self._planes = range(slab.start - self._halo.below, slab.stop + self._halo.above)
        angle = 2 * np.pi / grid.cells
        transforms = [_spline_transform(self.degree, angle * axis) for axis in grid.index]
        #: factors that turn the modes of a field into those of its spline coefficients
        self.inverse = (1.0 / (transforms[0] * transforms[1] * transforms[2])).astype(grid.real)

    def coefficients(self, spectral: np.ndarray) -> list[np.ndarray]:
        """Return the spline coefficients of fields with modes (c, kz, ky, kx), in the three parts of `with_ghosts`."""
        return self.with_ghosts(self.grid.backward(spectral * self.inverse))

    def with_ghosts(self, planes: np.ndarray) -> list[np.ndarray]:
        """Return coefficients (c, z_local, y, x) in three parts: ghost planes below, own planes, ghost planes above."""
        return self._halo.forward(planes)

    def at(self, coefficients: Sequence[np.ndarray], positions: np.ndarray) -> np.ndarray:
        """Return the values (n, c) of splines at positions (n, 3), given their coefficients (see `with_ghosts`).

        `around` states which positions are allowed and which errors are raised.
        """
        return self.around(positions).at(coefficients)

    def around(self, positions: np.ndarray) -> Splines:
        """Return the B-splines that contribute at positions (n, 3), for several uses at the same points.

        x and y may be anywhere. z, modulo the period, may be outside the slab by at most the margin. Raises HaloError
        if z is farther outside, and ValueError if a position is not finite.
        """
        try:
            return Splines(self.degree, positions, self.grid.cells, self.grid.decomposition.spacing, self._planes)
        except MisplacedPoint as error:
            position = np.asarray(positions)[error.number]
        if not np.isfinite(position).all():
            raise ValueError(f"interpolation: position {position} is not finite")
        raise HaloError("a particle moves farther out of its slab in one step than the ghost planes reach: "
                        "lower step, courant or max_step")

    def spread(self, values: np.ndarray, splines: Splines) -> np.ndarray:
        """Return planes (c, z_local, y, x): the sum over all points of `values` (n, c) times the point's splines.

        `splines` are those of the points, from `around`. The result is the transpose of `with_ghosts` followed by
        evaluation at the points. Collective.
        """
        parts = self._halo.parts(np.zeros((values.shape[1], *self.grid.physical_shape), self.grid.real))
        splines.spread(values, parts)
        return self._halo.adjoint(parts)


def ghost_planes(kind: str, margin: int) -> tuple[int, int]:
    """Return the numbers of ghost planes below and above the slab of a rank; see `SplineInterpolation`."""
    reach = (ORDERS[kind] - 1) // 2
    return reach + margin, reach + 1 + margin


def margin_for(distance: float, spacing: float) -> int:
    """Return the `margin` for points up to `distance` outside their slab, on a grid with this spacing."""
    return max(planes_within(distance, spacing), 1)


def spline_ranks(planes: int, kind: str, margin: int = 1) -> int:
    """Return the largest number of ranks for splines on a grid with so many planes."""
    return most_slabs(planes, max(ghost_planes(kind, margin)))


def _spline_transform(degree: int, angle: np.ndarray) -> np.ndarray:
    """Return the discrete Fourier transform, at k dx = `angle`, of the B-spline of this degree sampled at integers."""
    if degree == 3:
        return (2 + np.cos(angle)) / 3
    return (33 + 26 * np.cos(angle) + np.cos(2 * angle)) / 60
