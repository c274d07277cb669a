"""Smoothing kernels W(r) of compact support: two kernels of SPH, tabulated ones, and the learned kernel of Eq. 7.

Every kernel has unit integral over space, with W in units of 1/length^3, is nowhere negative, and is exactly zero for
r >= h, its support. The published form of the learned kernel is the exception: it may be negative, and the loss L_n
brings its integral only near one. It has a `mean_volume` L^3/N, the V_j of Eq. 6, and its sums are not normalised.
"""

import math
from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor, nn

from eddies.particles.dense_network import DenseNetwork

# Sharpness C of the sigmoid in Eq. 7, for lengths in units of h. The paper gives no number; its public code uses this
# value. The sigmoid is 1/2 at r = h and 0.9 at r = 0.78 h.
SIGMOID_SHARPNESS = 10.0
# Number of knots in a table of the learned kernel.
KNOTS = 129


class SmoothingKernel(Protocol):
    """W(r) in 1/length^3 and dW/dr in 1/length^4 for distances of any shape, zero for r >= `support`.

    With a `mean_volume` V = L^3/N, W may be negative, and averages are <A> = V sum_j A_j W, Eq. 6 as published. Without
    it, W is nowhere negative, particles have the volumes V_j = 1/sum_k W, and averages are normalised.
    """

    support: float
    mean_volume: float | None

    @property
    def pieces(self) -> Tensor:
        """Polynomial coefficients of W(r) on equal intervals of 0 <= r < support, (intervals, coefficients).

        The coefficients are those of u^0, u^1, ..., where u falls from 1 to 0 along an interval. With this u rounding
        errors are smallest near r = support, where W is small.
        """

    def value(self, distance: Tensor) -> Tensor: ...

    def derivative(self, distance: Tensor) -> Tensor: ...


class _Polynomial:
    """SmoothingKernel with a fixed shape W h^3 and its slope, functions of q = r/h on [0, 1); h is the support."""

    mean_volume = None
    shape_pieces: tuple[tuple[float, ...], ...]

    def __init__(self, support: float) -> None:
        self.support = support

    @property
    def pieces(self) -> Tensor:
        return torch.tensor(self.shape_pieces, dtype=torch.float64) / self.support**3

    def value(self, distance: Tensor) -> Tensor:
        return self._shape(torch.clamp(distance / self.support, max=1)) / self.support**3

    def derivative(self, distance: Tensor) -> Tensor:
        return self._slope(torch.clamp(distance / self.support, max=1)) / self.support**4


class CubicSpline(_Polynomial):
    """Cubic B-spline kernel of Monaghan & Lattanzio (1985), zero at r >= h."""

    shape_pieces = tuple(tuple(8 / math.pi * c for c in piece)
                         for piece in ((0.25, 0.75, 0.75, -0.75), (0, 0, 0, 0.25)))

    def _shape(self, q: Tensor) -> Tensor:
        return 8 / math.pi * torch.where(q < 0.5, 1 - 6 * q**2 * (1 - q), 2 * (1 - q) ** 3)

    def _slope(self, q: Tensor) -> Tensor:
        return 48 / math.pi * torch.where(q < 0.5, q * (3 * q - 2), -((1 - q) ** 2))


class WendlandC2(_Polynomial):
    """Wendland C2 kernel (Wendland 1995; Dehnen & Aly 2012) in three dimensions, zero at r >= h."""

    shape_pieces = (tuple(21 / (2 * math.pi) * c for c in (0, 0, 0, 0, 5, -4)),)

    def _shape(self, q: Tensor) -> Tensor:
        return 21 / (2 * math.pi) * (1 - q) ** 4 * (1 + 4 * q)

    def _slope(self, q: Tensor) -> Tensor:
        return -210 / math.pi * q * (1 - q) ** 3


def over_distance(slope: Tensor, distance: Tensor) -> Tensor:
    """W'/r, which is 0 for coincident particles since the slope vanishes at r = 0."""
    return slope / torch.where(distance > 0, distance, 1.0)


class HermiteKernel:
    """SmoothingKernel tabulated at uniform knots q = r/h = 0 ... 1, with cubic Hermite polynomials (C1) between them.

    Parameters
    ----------
    support : h.
    values, slopes : (knots,), the dimensionless W h^3 and d(W h^3)/dq; all results are differentiable in both.
    mean_volume : see SmoothingKernel. Without one, values must not be negative, and the magnitude of a slope is
        limited to 3 value / (distance of two knots): with steeper slopes a cubic may be negative between the knots.
    """

    def __init__(self, support: float, values: Tensor, slopes: Tensor, mean_volume: float | None = None) -> None:
        self.support, self.values, self.cells, self.mean_volume = support, values, len(values) - 1, mean_volume
        steepest = 3 * self.cells * values
        self.slopes = torch.clamp(slopes, -steepest, steepest) if mean_volume is None else slopes
        self._coefficients = self._cubics(values[:-1], values[1:], self.slopes[:-1], self.slopes[1:])

    def _cubics(self, start: Tensor, end: Tensor, first: Tensor, last: Tensor) -> tuple[Tensor, ...]:
        """Return the coefficients of a cubic for each cell, from the values and slopes at both ends of the cell."""
        rise, first, last = end - start, first / self.cells, last / self.cells
        return start, first, 3 * rise - 2 * first - last, first + last - 2 * rise

    def value(self, distance: Tensor) -> Tensor:
        inside, cell, t = self._locate(distance)
        a, b, c, d = self._at(cell)
        value = a + t * (b + t * (c + t * d))
        if self.mean_volume is None:
            value = torch.clamp(value, min=0)  # rounding can give negative values
        return torch.where(inside, value, torch.zeros_like(value)) / self.support**3

    def derivative(self, distance: Tensor) -> Tensor:
        inside, cell, t = self._locate(distance)
        _, b, c, d = self._at(cell)
        slope = (b + t * (2 * c + t * (3 * d))) * self.cells
        return torch.where(inside, slope, torch.zeros_like(slope)) / self.support**4

    @property
    def pieces(self) -> Tensor:
        cubics = self._cubics(self.values[1:], self.values[:-1], -self.slopes[1:], -self.slopes[:-1])
        return torch.stack(cubics, dim=1) / self.support**3

    @property
    def table(self) -> Tensor:
        """The values, then the slopes, of all knots. W(r) at any r is a linear function of these entries."""
        return torch.cat([self.values, self.slopes])

    def in_table(self, distance: Tensor) -> tuple[Tensor, Tensor]:
        """Return indices (4, m) of the table entries that give W at each distance (m,), and their factors (4, m)."""
        inside, cell, t = self._locate(distance)
        last = t * t * (3 - 2 * t)
        factors = torch.stack([1 - last, last, t * (1 - t) ** 2 / self.cells, t * t * (t - 1) / self.cells])
        entries = torch.stack([cell, cell + 1, cell + self.cells + 1, cell + self.cells + 2])
        return entries, torch.where(inside, factors, torch.zeros_like(factors)) / self.support**3

    def _locate(self, distance: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return whether each distance is within the support, its cell, and its position in the cell, from 0 to 1."""
        position = distance * (self.cells / self.support)
        cell = torch.clamp(position.detach().to(torch.int64), 0, self.cells - 1)
        return distance < self.support, cell, torch.clamp(position - cell, max=1)

    def _at(self, cell: Tensor) -> list[Tensor]:
        flat = cell.flatten()
        return [coefficient.index_select(0, flat).reshape(cell.shape) for coefficient in self._coefficients]


class KernelNetwork(nn.Module):
    """The learned kernel in one of two forms, with q = r/h, a network NN and a cutoff g.

    positive form : W(r) = alpha exp(NN(2 q^2 - 1)) g(q), where alpha makes the integral of W one.
    published form, Eq. 7 : W(r) = NN(q) g(q) / h^3, which may be negative.

    Parameters
    ----------
    support : h.
    hidden : widths of the tanh layers.
    cutoff : "smooth": g = (1 - q^2)^2, zero with zero slope at q = 1; or "sigmoid", the paper's
        g = 1/(1 + exp(C (q - 1))) with C = SIGMOID_SHARPNESS, which is 1/2 at q = 1, so the kernel ends with a jump.
    seed : seed of the initial weights.
    mean_volume : L^3/N for N particles, selects the published form; None for the positive form.

    In the published form the output layer contains the factor alpha, and the loss L_n of Eq. 11 brings the integral
    near one. Averages with this form must not be normalised, that is, divided by the sum of W: this sum is near zero
    where positive and negative weights cancel, and the result does not depend on alpha. With the positive form an
    average lies between the smallest and the largest of the averaged values.

    The positive form is an even function of q. It is smooth and has no slope at r = 0, as the gradient of a
    reconstructed field requires. Its output layer has small initial weights, so W is at first nearly proportional to g.
    """

    def __init__(self, support: float, hidden: Sequence[int] = (20, 20, 20, 20), cutoff: str = "smooth", seed: int = 1,
                 mean_volume: float | None = None) -> None:
        super().__init__()
        self.support, self.cutoff, self.mean_volume = support, cutoff, mean_volume
        self.network = DenseNetwork(1, hidden, 1, seed)
        self.positive = mean_volume is None
        if self.positive:
            with torch.no_grad():
                self.network.weights[-1].mul_(0.1)

    @property
    def formula(self) -> str:
        """The formula of W. It is stored with the weights, which are valid for this formula alone."""
        bell = "g" if self.cutoff == "smooth" else f"/ (1 + exp({SIGMOID_SHARPNESS:g} (q - 1)))"
        return f"{'exp(NN)' if self.positive else 'NN'} {bell}"

    def _unnormalised(self, knots: int) -> HermiteKernel:
        reference = self.network.weights[0]
        q = torch.linspace(0, 1, knots, dtype=reference.dtype, device=reference.device).unsqueeze(0)
        if self.positive:
            exponent, rise = self.network.with_tangent(2 * q * q - 1, 4 * q)
            shape = torch.exp(exponent)
            slope = shape * rise
        else:
            shape, slope = self.network.with_tangent(q, torch.ones_like(q))
        if self.cutoff == "smooth":
            bell, bell_slope = (1 - q * q) ** 2, -4 * q * (1 - q * q)
        else:
            bell = torch.sigmoid(SIGMOID_SHARPNESS * (1 - q))
            bell_slope = -SIGMOID_SHARPNESS * bell * (1 - bell)
        return HermiteKernel(self.support, (shape * bell)[0], (slope * bell + shape * bell_slope)[0],
                             self.mean_volume)

    def integral(self, knots: int = KNOTS) -> Tensor:
        """Return the integral of the kernel over space before normalisation: 1/alpha in the positive form.

        The loss of Eq. 11 brings the integral of the published form near one.
        """
        return integral(self._unnormalised(knots))

    def table(self, knots: int = KNOTS) -> HermiteKernel:
        """Tabulate the kernel at `knots` points; differentiable in the weights. The positive form has unit integral."""
        kernel = self._unnormalised(knots)
        if not self.positive:
            return kernel
        alpha = 1 / integral(kernel)
        return HermiteKernel(self.support, alpha * kernel.values, alpha * kernel.slopes)


def integral(kernel: SmoothingKernel) -> Tensor:
    """Return the integral of a kernel over space, 4 pi int r^2 W dr, exactly from its polynomial pieces."""
    pieces = kernel.pieces
    end = torch.arange(1, len(pieces) + 1, dtype=pieces.dtype, device=pieces.device).unsqueeze(1)
    power = torch.arange(1, pieces.shape[1] + 1, dtype=pieces.dtype, device=pieces.device)
    # int_0^1 u^(power - 1) (end - u)^2 du, with r = end - u in units of the length of a piece
    moments = end**2 / power - 2 * end / (power + 1) + 1 / (power + 2)
    return 4 * math.pi * (kernel.support / len(pieces)) ** 3 * (moments * pieces).sum()
