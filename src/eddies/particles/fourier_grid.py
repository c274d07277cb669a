"""Fields on a grid in torch: linear maps between particles, grid points and Fourier modes, with their adjoints.

Torch differentiates formulas composed of these maps automatically.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from eddies.kernels.splines import Splines
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.exchanges import sum_over_ranks
from eddies.particles.particle_set import as_numpy
from eddies.particles.rates import Rates
from eddies.spectral.interpolation import SplineInterpolation
from eddies.spectral.mode_operators import ModeOperators, gaussian_transfer
from eddies.spectral.spectral_grid import SYMMETRIC, SpectralGrid


class FourierGrid(ModeOperators):
    """A periodic grid and its Fourier modes. Along each axis it has as many cells as all slabs together have planes.

    Modes have |k_i| <= `resolved` for each component of k, in units of the smallest wavenumber. Fields are real tensors
    (c, z_local, y, x), modes complex ones (c, kz, ky, kx) as in `SpectralGrid`, on the host and in the precision of
    `dtype`. Values at positions are in double precision. Positions (n, 3) lie in this rank's slab or at most `reach`
    outside it; `reach` is the thickness of `margin` grid planes. Methods that convert between particles, fields and
    modes are collective, also in the backward pass.
    """

    def __init__(self, decomposition: SlabDecomposition, resolved: int, margin: int = 1,
                 dtype: torch.dtype = torch.float64) -> None:
        self.decomposition, self.resolved, self.dtype = decomposition, resolved, dtype
        self.spectral = SpectralGrid(decomposition, str(dtype).removeprefix("torch."), cutoff=resolved)
        self.spline = SplineInterpolation(self.spectral, "cubic", margin)
        self.reach = margin * decomposition.spacing
        super().__init__([torch.from_numpy(axis) for axis in self.spectral.wavevector],
                         torch.from_numpy(self.spectral.wavenumber_squared), torch.stack)
        #: |k| in units of the smallest wavenumber
        self.shell = torch.from_numpy(np.sqrt(self.spectral.index_squared))
        #: factor that turns the modes of a field into those of its spline coefficients
        self.prefilter = torch.from_numpy(self.spline.inverse)
        #: number of times that a stored mode occurs in a sum over all modes
        self.multiplicity = torch.from_numpy(self.spectral.multiplicity)
        self._sphere = (self.shell <= resolved).to(dtype)  # a product is twice as fast as `where`
        #: 1 for k = 0, 0 for all other modes
        self._zeroth = (self.shell == 0).to(dtype)
        self._transfers: dict[float, Tensor] = {}

    @property
    def highest(self) -> float:
        """k_c, the wavenumber of the highest modes along an axis."""
        return self.resolved * 2 * math.pi / self.decomposition.length

    def repeating(self, periods: Sequence[int]) -> Tensor:
        """Return whether a mode (kz, ky, kx) has these numbers of periods along x, y and z, or multiples of them."""
        unit = 2 * math.pi / self.decomposition.length
        x, y, z = (torch.round(k / unit).long() % count == 0 for k, count in zip(self.wavevector, periods))
        return x & y & z

    # ---- linear maps

    def to_modes(self, fields: Tensor) -> Tensor:
        return _ToModes.apply(fields, self)

    def to_fields(self, modes: Tensor) -> Tensor:
        """Fields (c, z_local, y, x) of modes (c, kz, ky, kx).

        The modes of a real field satisfy f(-k) = conj(f(k)). Only the part of the modes with kx = 0 that satisfies this
        relation contributes.
        """
        return _ToFields.apply(modes, self)

    def points(self, position: Tensor) -> Points:
        return Points(self.spline, position)

    def at(self, modes: Tensor, points: Points) -> Tensor:
        """Values (n, c) of modes at points, by cubic splines; differentiable in modes and positions."""
        return _Interpolated.apply(self.to_fields(modes * self.prefilter), points.position, points)

    def spread(self, values: Tensor, points: Points) -> Tensor:
        """Modes (c, kz, ky, kx) of the sum of the splines around points, each times its row of `values` (n, c).

        Differentiable in values and positions. Up to two factors, the number of grid points and the multiplicity of the
        modes, it is the adjoint of `at`.
        """
        return self.to_modes(_Spread.apply(values, points.position, points)) * self.prefilter

    def zeros(self, *leading: int) -> Tensor:
        return torch.zeros(*leading, *self.spectral.spectral_shape, dtype=self.dtype.to_complex())

    # ---- the zeroth mode, which is the mean over the box

    def mean(self, modes: Tensor) -> Tensor:
        """Return the mean (c,) over the box of fields with the given modes (c, kz, ky, kx), on all ranks.

        The mean is in double precision. Collective, differentiable.
        """
        own = (modes.real * self._zeroth).sum((1, 2, 3), dtype=torch.float64)
        return sum_over_ranks(self.decomposition.comm, own)

    def with_mean(self, modes: Tensor, mean: Tensor) -> Tensor:
        """Add the `mean` (c,) to the zeroth mode of each field."""
        return modes + mean.to(self.dtype)[:, None, None, None] * self._zeroth

    def without_mean(self, modes: Tensor) -> Tensor:
        """Set the zeroth mode to zero."""
        return modes * (1 - self._zeroth)

    # ---- formulas on modes

    def mean_square(self, modes: Tensor, above: float = -1.0, below: float = math.inf) -> Tensor:
        """Return the mean of u.u over space, where u has the given `modes` with `above` < |k| < `below` alone.

        The limits are in units of the smallest wavenumber. Collective, differentiable.
        """
        square = (modes.real.square() + modes.imag.square()).sum(0) * self.multiplicity
        inside = (self.shell > above) & (self.shell < below)
        return sum_over_ranks(self.decomposition.comm, torch.where(inside, square, 0.0).sum(dtype=torch.float64))

    def filter_transfer(self, width: float) -> Tensor:
        """Transfer function G (kz, ky, kx) of the Gaussian filter of this width; see `gaussian_transfer`."""
        if width not in self._transfers:
            self._transfers[width] = torch.from_numpy(gaussian_transfer(self.spectral.wavenumber_squared, width))
        return self._transfers[width]

    def hidden_stress(self, stress: Tensor) -> Rates:
        """Force and pressure of a subgrid stress, from its modes tau (6, kz, ky, kx).

        `pressure_of` gives the pressure p_tau of the stress. The force is

            -grad p_tau - div tau = -P[div tau],   P the projection on solenoidal fields.
        """
        divergence = self.stress_divergence(stress)
        pressure = self.pressure_of(stress)
        return Rates(force_modes=-(divergence + self.gradient(pressure)), pressure_modes=pressure)

    def slopes(self, vector: Tensor) -> Tensor:
        """Fields d_j u_i (3, 3, z_local, y, x), with indices i, j, of a vector u given by its modes."""
        modes = torch.cat([self.gradient(component) for component in vector])
        return self.to_fields(modes).unflatten(0, (3, 3))

    def products(self, first: Tensor, second: Tensor) -> Tensor:
        """Modes (6, kz, ky, kx) of the products a_i b_j of two fields (3, ..., z_local, y, x), ij = xx, yy, zz, xy, ...

        If the fields have more axes between the component and the grid, the products are summed over these axes.
        """
        fields = [first[i] * second[j] for i, j in SYMMETRIC]
        return self.to_modes(torch.stack([field.sum(0) if field.dim() > 3 else field for field in fields]))

    def squares(self, vector: Tensor) -> Tensor:
        """Modes (6, kz, ky, kx) with |k| <= `resolved` of the products u_i u_j of a vector u given by its modes."""
        return self.within(_Squares.apply(vector, self))

    def within(self, vector: Tensor) -> Tensor:
        """Set the modes of a vector with |k| > `resolved` to zero."""
        return vector * self._sphere


class Points:
    """Positions (n, 3) among the planes of a grid, and the splines around them, which are computed once."""

    def __init__(self, spline: SplineInterpolation, position: Tensor) -> None:
        self.spline, self.position = spline, position

    @functools.cached_property
    def _splines(self) -> Splines:
        return self.spline.around(as_numpy(self.position))

    def at(self, parts: Sequence[np.ndarray]) -> Tensor:
        """Values (n, c) at the positions. `parts` are the planes of spline coefficients together with ghost planes."""
        return torch.from_numpy(self._splines.at(parts)).to(self.position.device)

    def slope_along(self, parts: Sequence[np.ndarray], factors: Tensor) -> Tensor:
        """Spatial gradient (n, 3) of sum_c factors_c f_c, with interpolated fields f_c and fixed `factors` (n, c)."""
        return torch.from_numpy(self._splines.slope(parts, as_numpy(factors.double()))).to(self.position)

    def spread(self, values: Tensor) -> Tensor:
        """Transpose of `at`: values (n, c) added to planes (c, z_local, y, x)."""
        return torch.from_numpy(self.spline.spread(as_numpy(values.double()), self._splines))


# Modes with kx > 0 count twice in a sum over all modes. So the backward transform is the adjoint of the forward one up
# to two factors, `multiplicity` and the number of grid points.


class _ToModes(torch.autograd.Function):
    @staticmethod
    def forward(ctx, fields: Tensor, grid: FourierGrid) -> Tensor:
        ctx.grid = grid
        return torch.from_numpy(grid.spectral.forward(as_numpy(fields)))

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None]:
        grid = ctx.grid
        fields = grid.spectral.backward(as_numpy(gradient.resolve_conj() / grid.multiplicity))
        return torch.from_numpy(fields) / grid.spectral.cells**3, None


class _ToFields(torch.autograd.Function):
    @staticmethod
    def forward(ctx, modes: Tensor, grid: FourierGrid) -> Tensor:
        ctx.grid = grid
        return torch.from_numpy(grid.spectral.backward(as_numpy(modes.resolve_conj())))

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None]:
        grid = ctx.grid
        modes = torch.from_numpy(grid.spectral.forward(as_numpy(gradient)))
        return modes * (grid.spectral.cells**3 * grid.multiplicity), None


class _Squares(torch.autograd.Function):
    """`FourierGrid.products` of a vector with itself, computed for a few planes at a time.

    Fields are not stored; the backward pass computes them again.
    """

    @staticmethod
    def forward(ctx, modes: Tensor, grid: FourierGrid) -> Tensor:
        ctx.grid = grid
        ctx.save_for_backward(modes)
        return torch.from_numpy(grid.spectral.squares(as_numpy(modes.resolve_conj())))

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None]:
        with torch.enable_grad():
            modes = ctx.saved_tensors[0].detach().requires_grad_()
            fields = ctx.grid.to_fields(modes)
            return torch.autograd.grad(ctx.grid.products(fields, fields), modes, gradient)[0], None


class _Interpolated(torch.autograd.Function):
    """Values (n, c) at positions (n, 3) from spline coefficients (c, z_local, y, x)."""

    @staticmethod
    def forward(ctx, planes: Tensor, position: Tensor, points: Points) -> Tensor:
        ctx.points, ctx.parts = points, points.spline.with_ghosts(as_numpy(planes))
        return points.at(ctx.parts)

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        by_planes = ctx.points.spread(gradient) if ctx.needs_input_grad[0] else None
        by_position = ctx.points.slope_along(ctx.parts, gradient) if ctx.needs_input_grad[1] else None
        return by_planes, by_position, None


class _Spread(torch.autograd.Function):
    """Transpose of `_Interpolated`: values (n, c) added to planes (c, z_local, y, x)."""

    @staticmethod
    def forward(ctx, values: Tensor, position: Tensor, points: Points) -> Tensor:
        ctx.points = points
        ctx.save_for_backward(values)
        return points.spread(values)

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        points, (values,) = ctx.points, ctx.saved_tensors
        parts = points.spline.with_ghosts(as_numpy(gradient))
        return points.at(parts).to(values), points.slope_along(parts, values), None
