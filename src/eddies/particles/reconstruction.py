"""Fields and their gradients from particles: kernel averages (Eqs. 5 and 6), normalised but for kernels that may be
negative, and moving least squares."""

from __future__ import annotations

import torch
from torch import Tensor

from eddies.parallel.slab import SlabDecomposition
from eddies.particles.pairs import Pairs
from eddies.particles.smoothing_kernels import SmoothingKernel

# Points of the grid, near particles, that are looked at together: about a core's cache.
POINTS_TOGETHER = 1 << 18
# Of moving least squares, what is added to the squares of all coefficients but the constant, see there: below 1e-4 it
# changes no error of a filtered field, and of particles without a force, which gather, it bounds the gradients.
RIDGE = 1e-4


def volumes(kernel: SmoothingKernel, pairs: Pairs) -> Tensor:
    """Volume of each particle, 1 / (W(0) + sum_j W(x_i - x_j)), shape (count,), in length^3; of a kernel that has
    a mean volume this one.

    `pairs` leaves out the particle itself, which the first term counts once.
    """
    if kernel.mean_volume is not None:
        return pairs.distance.new_full((pairs.count,), kernel.mean_volume)
    at_centre = kernel.value(pairs.distance.new_zeros(1))
    return 1 / (at_centre + pairs.sum(kernel.value(pairs.distance)))


def reconstruct(
    kernel: SmoothingKernel, pairs: Pairs, sender_volumes: Tensor, sender_values: Tensor
) -> Tensor:
    """<A>(x) = sum_j V_j A_j W(x - x_j) / sum_j V_j W(x - x_j) at the receivers: (count, components); of a kernel with
    a mean volume the numerator alone, Eq. 6.

    Parameters
    ----------
    kernel : smoothing kernel whose support does not exceed the cutoff of the pairs.
    pairs : receivers are the points x. To evaluate at the particles themselves, the pairs must include each
        particle with itself.
    sender_volumes : (s,), volumes of all local particles, as `volumes` gives them.
    sender_values : (s, components), the quantity A at all local particles.

    A constant is reproduced to rounding where sums are normalised. Zero where no particle lies within the support.
    """
    return _average(kernel, pairs, pairs.at_senders(sender_volumes), pairs.at_senders(sender_values).T)[0]


@torch.no_grad()
def reconstruct_on_grid(
    kernel: SmoothingKernel, slab: SlabDecomposition, position: Tensor, volumes: Tensor, values: Tensor
) -> Tensor:
    """`reconstruct` at this slab's points (m, components) of the grid with as many cells as the slabs have planes, z
    slowest, from all local particles: position (s, 3), owned, then ghosts.

    Each particle is added to the points in the cube around it. A regular grid needs no search for neighbours, most of
    the cost of the other way.
    """
    cells, side = slab.planes, int(2 * kernel.support / slab.spacing) + 1
    first = torch.ceil((position - kernel.support) / slab.spacing).to(torch.int64)
    index = first.unsqueeze(2) + torch.arange(side, device=position.device)
    gap = index.to(position.dtype) * slab.spacing - position.unsqueeze(2)
    square = gap.to(values.dtype).square()
    # On one rank z is periodic, as x and y are; on several the ghosts stand where they are seen from.
    z = (index[:, 2] % cells if slab.size == 1 else index[:, 2]) - slab.start
    square[:, 2].masked_fill_((z < 0) | (z >= slab.count), torch.inf)
    columns = torch.cat([volumes.unsqueeze(0), volumes * values.T])
    sums = columns.new_zeros(len(columns), slab.count * cells**2)
    for some in torch.arange(len(position), device=position.device).split(max(POINTS_TOGETHER // side**3, 1)):
        square_x, square_y, square_z = square[some].unbind(1)
        square_distance = _outer_sum(square_z, square_y, square_x)
        near = torch.nonzero(square_distance < kernel.support**2).squeeze(1)
        weight = kernel.value(square_distance.index_select(0, near).sqrt())
        point = _outer_sum(z[some] * cells**2, index[some, 1] % cells * cells, index[some, 0] % cells)
        point, particle = point.index_select(0, near), some.index_select(0, near // side**3)
        for column, total in zip(columns, sums):
            total.index_add_(0, point, weight * column.index_select(0, particle))
    return (sums[1:] * normalisation(kernel, sums[0])).T


def reconstruct_with_gradient(
    kernel: SmoothingKernel, pairs: Pairs, sender_volumes: Tensor, sender_values: Tensor
) -> tuple[Tensor, Tensor]:
    """`reconstruct`, and its gradient (count, components, 3), the last axis the direction of the derivative.

    The gradient is sum_j V_j (A_j - <A>) grad W(x - x_j) / sum_j V_j W, the asymmetric finite-particle form, and
    exactly the derivative of the reconstructed field; of a kernel with a mean volume the numerator alone. Arguments as
    there.
    """
    volume, value, distance = pairs.at_senders(sender_volumes), pairs.at_senders(sender_values).T, pairs.distance
    average, factor = _average(kernel, pairs, volume, value)
    # Both the slope and the direction vanish with the distance.
    apart = torch.where(distance > 0, distance, torch.ones_like(distance))
    gradient = (volume * kernel.derivative(distance) / apart) * pairs.displacement.T
    deviation = value - average.T.contiguous().index_select(1, pairs.segment)
    products = deviation.unsqueeze(1) * gradient.unsqueeze(0)
    sums = pairs.sum(products.flatten(0, 1).T).reshape(pairs.count, *products.shape[:2])
    return average, sums * factor[:, :, None]


@torch.no_grad()
def moving_least_squares(kernel: SmoothingKernel, pairs: Pairs, degree: int, mean_volume: float, sender_values: Tensor,
                         ridge: float = RIDGE) -> tuple[Tensor, Tensor]:
    """A field (n, c) and its gradient (n, c, 3) at the receivers: value and gradient there of the polynomial p of a
    degree, 1 or 2, with the least

        V sum_j W(x - x_j) |p(x_j) - A_j|^2 + ridge (sum of the squares of all coefficients of p but the constant),

    p in (x_j - x)/h, V the mean volume of a particle, so that V sum_j W is one on average. Without a ridge polynomials
    of this degree are exact. A constant is so always: where neighbours are few, far or badly placed, the ridge
    outweighs them and leaves the average with W. Zero where no particle lies within the support.

    Parameters
    ----------
    kernel : smoothing kernel that is nowhere negative, with a support that does not exceed the cutoff of the pairs.
    pairs : receivers are the points x; particles that receive are among their own neighbours.
    sender_values : (s, c), the field A at all local particles.
    """
    monomials = _monomials(-pairs.displacement.double() / kernel.support, degree)
    weighted = (mean_volume * kernel.value(pairs.distance.double()))[:, None] * monomials
    matrix = pairs.sum(weighted[:, :, None] * monomials[:, None, :])
    right = pairs.sum(weighted[:, :, None] * pairs.at_senders(sender_values).double()[:, None, :])
    size = matrix.shape[1]
    penalty = ridge * torch.eye(size, dtype=matrix.dtype, device=matrix.device)
    penalty[0, 0] = 0
    factor, failed = torch.linalg.cholesky_ex(matrix + penalty)
    failed = failed[:, None, None] > 0
    identity = torch.eye(size, dtype=matrix.dtype, device=matrix.device)
    found = torch.cholesky_solve(torch.where(failed, 0, right), torch.where(failed, identity, factor))
    found = found.to(sender_values.dtype)
    return found[:, 0], found[:, 1:4].transpose(1, 2) / kernel.support


def _monomials(x: Tensor, degree: int) -> Tensor:
    """1, x, y, z and, of degree 2, xx, xy, xz, yy, yz, zz of (m, 3): (m, 4 or 10)."""
    columns = [torch.ones_like(x[:, 0]), *x.unbind(1)]
    if degree == 2:
        columns += [x[:, i] * x[:, j] for i in range(3) for j in range(i, 3)]
    return torch.stack(columns, dim=1)


def _average(kernel: SmoothingKernel, pairs: Pairs, volume: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
    """<A> (count, components) of volumes (m,) and values (components, m) of pairs, and by what sums are multiplied
    (count, 1)."""
    weight = volume * kernel.value(pairs.distance)
    sums = pairs.sum(torch.cat([weight.unsqueeze(0), weight * value]).T)
    factor = normalisation(kernel, sums[:, :1])
    return sums[:, 1:] * factor, factor


def _outer_sum(z: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """z_i + y_j + x_k of each row of three (n, side): (n side^3,), x fastest."""
    plane = y.unsqueeze(2) + x.unsqueeze(1)
    return (z[:, :, None, None] + plane.unsqueeze(1)).flatten()


def normalisation(kernel: SmoothingKernel, denominator: Tensor) -> Tensor:
    """1 / denominator, and zero where no particle contributes; one of a kernel with a mean volume."""
    if kernel.mean_volume is not None:
        return torch.ones_like(denominator)
    empty = denominator == 0
    return torch.where(empty, torch.zeros_like(denominator), 1 / torch.where(empty, 1, denominator))
