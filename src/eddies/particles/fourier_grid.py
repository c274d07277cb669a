"""Fields on a grid in torch: the linear steps between particles, grid points and Fourier modes, each with its adjoint.

Everything made of them is a formula that differentiates itself.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from eddies.parallel.slab import SlabDecomposition
from eddies.particles.particle_set import as_numpy
from eddies.particles.rates import Rates
from eddies.spectral.interpolation import SplineInterpolation
from eddies.spectral.spectral_grid import SpectralGrid


class FourierGrid:
    """A periodic grid of one cell for each plane of the slabs, with the modes |k_i| <= `resolved`.

    Fields are real tensors (c, z_local, y, x), modes complex ones (c, kz, ky, kx) as in `SpectralGrid`; both are in
    double precision and on the host. Vectors have the order x, y, z, symmetric matrices xx, yy, zz, xy, xz, yz.
    Positions (n, 3) lie in this rank's slab or at most `reach` outside, which is `margin` grid planes. All methods that
    change between particles, fields and modes are collective, also on the way back of a gradient.
    """

    def __init__(self, decomposition: SlabDecomposition, resolved: int, margin: int = 1) -> None:
        self.decomposition, self.resolved = decomposition, resolved
        self.spectral = SpectralGrid(decomposition, cutoff=resolved)
        self.spline = SplineInterpolation(self.spectral, "cubic", margin)
        self.reach = margin * decomposition.spacing
        #: kx, ky, kz, to broadcast over (kz, ky, kx)
        self.wavevector = tuple(torch.from_numpy(axis) for axis in self.spectral.wavevector)
        #: |k|, in units of the smallest one
        self.shell = torch.from_numpy(np.sqrt(self.spectral.index_squared))
        self.wavenumber_squared = torch.from_numpy(self.spectral.wavenumber_squared)
        self._inverse_squared = torch.where(self.shell > 0, 1 / self.wavenumber_squared, 0.0)
        self._prefilter = torch.from_numpy(self.spline.inverse)
        #: how often a stored mode stands in the full sum
        self.multiplicity = torch.from_numpy(self.spectral.multiplicity)

    # ---- linear steps

    def to_modes(self, fields: Tensor) -> Tensor:
        """Modes of fields."""
        return _ToModes.apply(fields, self)

    def to_fields(self, modes: Tensor) -> Tensor:
        """Fields of modes; of those with kx = 0 the part that belongs to a real field."""
        return _ToFields.apply(modes, self)

    def at(self, modes: Tensor, position: Tensor) -> Tensor:
        """Values (n, c) of modes at positions, by cubic splines; differentiable in both."""
        return _Interpolated.apply(self.to_fields(modes * self._prefilter), position, self)

    def spread(self, values: Tensor, position: Tensor) -> Tensor:
        """Modes (c, kz, ky, kx) of a sum of splines around positions with weights `values` (n, c); differentiable in
        both. Up to the number of points and the multiplicity of modes the adjoint of `at`."""
        return self.to_modes(_Spread.apply(values, position, self)) * self._prefilter

    # ---- formulas on modes

    def gradient(self, scalar: Tensor) -> Tensor:
        """i k f of one component (kz, ky, kx): (3, kz, ky, kx)."""
        return torch.stack([1j * k * scalar for k in self.wavevector])

    def divergence(self, vector: Tensor) -> Tensor:
        """i k.u of a vector: (kz, ky, kx)."""
        return 1j * self._along(vector)

    def solenoidal(self, vector: Tensor) -> Tensor:
        """u - k (k.u) / k^2, the projection of a vector on solenoidal fields."""
        longitudinal = self._along(vector) * self._inverse_squared
        return vector - torch.stack([k * longitudinal for k in self.wavevector])

    def stress_divergence(self, stress: Tensor) -> Tensor:
        """d_j tau_ij of a symmetric matrix (6, kz, ky, kx): (3, kz, ky, kx)."""
        xx, yy, zz, xy, xz, yz = stress
        return torch.stack([self.divergence(row) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))])

    def pressure_of(self, stress: Tensor) -> Tensor:
        """p (kz, ky, kx) with  laplacian p = -d_i d_j tau_ij  and mean zero, of a symmetric matrix (6, kz, ky, kx)."""
        return self.divergence(self.stress_divergence(stress)) * self._inverse_squared

    def hidden_stress(self, stress: Tensor) -> Rates:
        """What a stress tau that the filter hides does to the filtered flow, of (6, kz, ky, kx): its divergence and the
        gradient of its pressure p_tau (`pressure_of`), which together are the force

            -grad p_tau - div tau = -P[div tau],   P the projection on solenoidal fields."""
        return Rates(force_modes=-self.solenoidal(self.stress_divergence(stress)),
                     pressure_modes=self.pressure_of(stress))

    def slopes(self, vector: Tensor) -> Tensor:
        """Fields d_j u_i of a vector's modes: (3, 3, z_local, y, x) [component, direction]."""
        modes = torch.cat([self.gradient(component) for component in vector])
        return self.to_fields(modes).unflatten(0, (3, 3))

    def products(self, first: Tensor, second: Tensor) -> Tensor:
        """Modes (6, kz, ky, kx) of a_i.b_j, symmetric in i and j, of fields (3, ..., z_local, y, x); what stands
        between is summed over."""
        pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
        fields = [first[i] * second[j] for i, j in pairs]
        return self.to_modes(torch.stack([field.sum(0) if field.dim() > 3 else field for field in fields]))

    def within(self, vector: Tensor) -> Tensor:
        """The modes with |k| <= `resolved` of a vector."""
        return torch.where(self.shell <= self.resolved, vector, 0.0)

    def _along(self, vector: Tensor) -> Tensor:
        kx, ky, kz = self.wavevector
        return kx * vector[0] + ky * vector[1] + kz * vector[2]


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


class _Interpolated(torch.autograd.Function):
    """Spline coefficients (c, z_local, y, x) at positions (n, 3): (n, c)."""

    @staticmethod
    def forward(ctx, planes: Tensor, position: Tensor, grid: FourierGrid) -> Tensor:
        ctx.grid, ctx.padded = grid, grid.spline.with_ghosts(as_numpy(planes))
        ctx.save_for_backward(position)
        return torch.from_numpy(grid.spline.at(ctx.padded, as_numpy(position))).to(position.device)

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        spline, (position,) = ctx.grid.spline, ctx.saved_tensors
        weights, by_planes, by_position = as_numpy(gradient), None, None
        if ctx.needs_input_grad[0]:
            by_planes = torch.from_numpy(np.ascontiguousarray(spline.spread(weights, as_numpy(position))))
        if ctx.needs_input_grad[1]:
            by_position = torch.from_numpy(spline.slope_along(ctx.padded, as_numpy(position), weights)).to(position)
        return by_planes, by_position, None


class _Spread(torch.autograd.Function):
    """Transpose of `_Interpolated`: values (n, c) added to planes (c, z_local, y, x)."""

    @staticmethod
    def forward(ctx, values: Tensor, position: Tensor, grid: FourierGrid) -> Tensor:
        ctx.grid = grid
        ctx.save_for_backward(values, position)
        return torch.from_numpy(np.ascontiguousarray(grid.spline.spread(as_numpy(values), as_numpy(position))))

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        spline, (values, position) = ctx.grid.spline, ctx.saved_tensors
        padded, points = spline.with_ghosts(as_numpy(gradient)), as_numpy(position)
        by_values = torch.from_numpy(spline.at(padded, points)).to(values)
        return by_values, torch.from_numpy(spline.slope_along(padded, points, as_numpy(values))).to(position), None
