"""Fields on a grid in torch: the linear steps between particles, grid points and Fourier modes, each with its adjoint.

Everything made of them is a formula that differentiates itself.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from eddies.kernels.splines import Splines
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.particle_set import as_numpy
from eddies.particles.rates import Rates
from eddies.spectral.interpolation import SplineInterpolation
from eddies.spectral.mode_operators import ModeOperators, gaussian_transfer
from eddies.spectral.spectral_grid import SYMMETRIC, SpectralGrid


class FourierGrid(ModeOperators):
    """A periodic grid of one cell for each plane of the slabs, with the modes |k_i| <= `resolved`.

    Fields are real tensors (c, z_local, y, x), modes complex ones (c, kz, ky, kx) as in `SpectralGrid`; both are on the
    host and of the precision of `dtype`, single or double. Values at positions are in double precision. Positions
    (n, 3) lie in this rank's slab or at most `reach` outside, which is `margin` grid planes. All methods that change
    between particles, fields and modes are collective, also on the way back of a gradient.
    """

    def __init__(self, decomposition: SlabDecomposition, resolved: int, margin: int = 1,
                 dtype: torch.dtype = torch.float64) -> None:
        self.decomposition, self.resolved, self.dtype = decomposition, resolved, dtype
        self.spectral = SpectralGrid(decomposition, str(dtype).removeprefix("torch."), cutoff=resolved)
        self.spline = SplineInterpolation(self.spectral, "cubic", margin)
        self.reach = margin * decomposition.spacing
        super().__init__([torch.from_numpy(axis) for axis in self.spectral.wavevector],
                         torch.from_numpy(self.spectral.wavenumber_squared), torch.stack)
        #: |k|, in units of the smallest one
        self.shell = torch.from_numpy(np.sqrt(self.spectral.index_squared))
        #: by which modes become those of spline coefficients
        self.prefilter = torch.from_numpy(self.spline.inverse)
        #: how often a stored mode stands in the full sum
        self.multiplicity = torch.from_numpy(self.spectral.multiplicity)
        self._sphere = (self.shell <= resolved).to(dtype)  # products take half of the time of `where`
        self._transfers: dict[float, Tensor] = {}

    # ---- linear steps

    def to_modes(self, fields: Tensor) -> Tensor:
        """Modes of fields."""
        return _ToModes.apply(fields, self)

    def to_fields(self, modes: Tensor) -> Tensor:
        """Fields of modes; of those with kx = 0 the part that belongs to a real field."""
        return _ToFields.apply(modes, self)

    def points(self, position: Tensor) -> Points:
        """Positions at which fields are asked for more than once."""
        return Points(self.spline, position)

    def at(self, modes: Tensor, position: Tensor | Points) -> Tensor:
        """Values (n, c) of modes at positions, by cubic splines; differentiable in both."""
        points = self._as_points(position)
        return _Interpolated.apply(self.to_fields(modes * self.prefilter), points.position, points)

    def spread(self, values: Tensor, position: Tensor | Points) -> Tensor:
        """Modes (c, kz, ky, kx) of a sum of splines around positions with weights `values` (n, c); differentiable in
        both. Up to the number of points and the multiplicity of modes the adjoint of `at`."""
        points = self._as_points(position)
        return self.to_modes(_Spread.apply(values, points.position, points)) * self.prefilter

    def _as_points(self, position: Tensor | Points) -> Points:
        return position if isinstance(position, Points) else self.points(position)

    def zeros(self, *leading: int) -> Tensor:
        """Modes (*leading, kz, ky, kx) of nothing."""
        return torch.zeros(*leading, *self.spectral.spectral_shape, dtype=self.dtype.to_complex())

    # ---- formulas on modes

    def filter_transfer(self, width: float) -> Tensor:
        """`gaussian_transfer` G of each mode (kz, ky, kx), made once."""
        if width not in self._transfers:
            self._transfers[width] = torch.from_numpy(gaussian_transfer(self.spectral.wavenumber_squared, width))
        return self._transfers[width]

    def hidden_stress(self, stress: Tensor) -> Rates:
        """What a stress tau that the filter hides does to the filtered flow, of (6, kz, ky, kx): its divergence and the
        gradient of its pressure p_tau (`pressure_of`), which together are the force

            -grad p_tau - div tau = -P[div tau],   P the projection on solenoidal fields."""
        divergence = self.stress_divergence(stress)
        pressure = self.pressure_of(stress)
        return Rates(force_modes=-(divergence + self.gradient(pressure)), pressure_modes=pressure)

    def slopes(self, vector: Tensor) -> Tensor:
        """Fields d_j u_i of a vector's modes: (3, 3, z_local, y, x) [component, direction]."""
        modes = torch.cat([self.gradient(component) for component in vector])
        return self.to_fields(modes).unflatten(0, (3, 3))

    def products(self, first: Tensor, second: Tensor) -> Tensor:
        """Modes (6, kz, ky, kx) of a_i.b_j, symmetric in i and j, of fields (3, ..., z_local, y, x); what stands
        between is summed over."""
        fields = [first[i] * second[j] for i, j in SYMMETRIC]
        return self.to_modes(torch.stack([field.sum(0) if field.dim() > 3 else field for field in fields]))

    def squares(self, vector: Tensor) -> Tensor:
        """Modes (6, kz, ky, kx), |k| <= `resolved`, of u_i u_j of a vector's modes."""
        return self.within(_Squares.apply(vector, self))

    def within(self, vector: Tensor) -> Tensor:
        """The modes with |k| <= `resolved` of a vector."""
        return vector * self._sphere


class Points:
    """Positions (n, 3) among the planes of a grid, and the splines around them, which are found once."""

    def __init__(self, spline: SplineInterpolation, position: Tensor) -> None:
        self.spline, self.position = spline, position

    @functools.cached_property
    def _splines(self) -> Splines:
        return self.spline.around(as_numpy(self.position))

    def at(self, parts: Sequence[np.ndarray]) -> Tensor:
        """Values (n, c) of planes with those of the neighbours."""
        return torch.from_numpy(self._splines.at(parts)).to(self.position.device)

    def slope_along(self, parts: Sequence[np.ndarray], factors: Tensor) -> Tensor:
        """Gradient (n, 3) with respect to the positions of sum_c factors_c f_c, the factors (n, c) held fixed."""
        return torch.from_numpy(self._splines.slope(parts, as_numpy(factors.double()))).to(self.position)

    def spread(self, values: Tensor) -> Tensor:
        """Transpose of `at` on planes with ghosts: values (n, c) added to planes (c, z_local, y, x)."""
        return torch.from_numpy(self.spline.spread(as_numpy(values.double()), self._splines))


# Modes with kx > 0 stand for two, so the transform back is the adjoint of the transform forth but for `multiplicity`
# and the number of points.


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
    """`FourierGrid.products` of a vector with itself, a few planes at a time: fields are not kept, so on the way back
    they are made anew."""

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
    """Spline coefficients (c, z_local, y, x) at positions (n, 3): (n, c)."""

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
