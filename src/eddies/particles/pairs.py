"""Pairs of neighbouring particles in the units of a model, and sums over each particle's neighbours, by torch or by the
compiled library."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from eddies.kernels.pairs import CompiledPairs, PairSpace, Summand
from eddies.particles.flow_units import FlowUnits
from eddies.particles.particle_set import as_numpy
from eddies.particles.periodic_box import safe_norm


@dataclass(frozen=True)
class Pairs:
    """Ordered pairs (i, j) of a receiver i and a sender j, sorted by receiver.

    Columns of pairs are stored component by component: a (m, 3) column is the transpose of a contiguous (3, m) array,
    which is several times faster.

    Parameters
    ----------
    receiver : int64 (m,), row of i among the local particles or the receiving points.
    segment : int64 (m,), row of i in the output, in [0, count), not decreasing.
    sender : int64 (m,), row of j among the local particles (owned, then ghosts).
    displacement : (m, 3), x_i - x_j between nearest images.
    distance : (m,), length of the displacement; its gradient is zero where the length is zero.
    count : number of output rows.
    """

    receiver: Tensor
    segment: Tensor
    sender: Tensor
    displacement: Tensor
    distance: Tensor
    count: int

    @cached_property
    def offsets(self) -> Tensor:
        """First pair of each output row and, at the end, the number of pairs: int64 (count + 1,)."""
        return torch.searchsorted(self.segment, torch.arange(self.count + 1, device=self.segment.device))

    def at_receivers(self, column: Tensor) -> Tensor:
        return gather_rows(column, self.receiver)

    def at_senders(self, column: Tensor) -> Tensor:
        return gather_rows(column, self.sender)

    def sum(self, values: Tensor) -> Tensor:
        """Sum the values (components, m) of the pairs of each output row: (components, count).

        The order of summation is fixed.
        """
        return _SegmentSum.apply(values, self.offsets, self.segment)


def gather_rows(column: Tensor, index: Tensor) -> Tensor:
    """column[index] for a column (n, ...): (m, ...), stored component by component."""
    if column.dim() == 1:
        return column.index_select(0, index)
    gathered = torch.stack([component.index_select(0, index) for component in column.flatten(1).unbind(1)])
    return gathered.T.reshape(len(index), *column.shape[1:])


class _SegmentSum(torch.autograd.Function):
    """Sums of the columns of a (components, m) array within each segment.

    Segment i has the columns offsets[i], ..., offsets[i + 1] - 1. On a CPU numpy's sum is the fastest."""

    @staticmethod
    def forward(ctx, values: Tensor, offsets: Tensor, segment: Tensor) -> Tensor:
        ctx.save_for_backward(segment)
        if values.device.type != "cpu":
            return torch.segment_reduce(values.T.contiguous(), "sum", offsets=offsets, axis=0).T.contiguous()
        starts, stops = offsets[:-1].numpy(), offsets[1:].numpy()
        filled = np.flatnonzero(stops > starts)
        sums = values.new_zeros(len(values), len(starts))
        if len(filled):
            # reduceat sums up to the next start, so the starts of rows without pairs are left out.
            sums.numpy()[:, filled] = np.add.reduceat(values.detach().numpy(), starts[filled], axis=1)
        return sums

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None, None]:
        (segment,) = ctx.saved_tensors
        return torch.stack([component.index_select(0, segment) for component in gradient.unbind(0)]), None, None


class ScaledPairs:
    """Pairs (i, j) and their quantities in the units of a model, each computed at first use.

    These are x = (x_i - x_j)/d (3, m), v = (v_i - v_j)/v_rms (3, m) and rho' = (rho - rho_0)/rho_rms. d is the filter
    width, rho_0 the mean density, and v_rms and rho_rms are the scales of velocity and density in ReferenceScales.

    Parameters
    ----------
    pairs : in the units of the simulation.
    column : returns the column "velocity" or "density" (s, ...) of the particles that this rank sees.
    flow : has the units and the radius of interaction.
    """

    def __init__(self, pairs: Pairs, column: Callable[[str], Tensor], flow: FlowUnits) -> None:
        self.pairs, self.column, self.flow = pairs, column, flow

    @cached_property
    def x(self) -> Tensor:
        return self.pairs.displacement.T / self.flow.scales.filter_width

    @cached_property
    def v(self) -> Tensor:
        return self.velocity_difference / self.flow.scales.velocity

    @cached_property
    def velocity_difference(self) -> Tensor:
        """v_i - v_j (3, m) in the units of the simulation."""
        velocity = self.column("velocity")
        return (self.pairs.at_receivers(velocity) - self.pairs.at_senders(velocity)).T.to(self.pairs.displacement)

    @cached_property
    def densities(self) -> tuple[Tensor, Tensor]:
        """rho'_i and rho'_j of each pair, each (m,)."""
        scales, density = self.flow.scales, self.column("density")
        own, other = (((column - scales.density_mean) / scales.density).to(self.pairs.displacement)
                      for column in (self.pairs.at_receivers(density), self.pairs.at_senders(density)))
        return own, other

    @cached_property
    def distance(self) -> Tensor:
        """Length of x (m,)."""
        return self.pairs.distance / self.flow.scales.filter_width

    @cached_property
    def approach(self) -> Tensor:
        """x.v (m,), negative for approaching particles."""
        return (self.x * self.v).sum(0)

    @cached_property
    def weight(self) -> Tensor:
        """w = (1 - q^2)^2 (m,), where q is the distance divided by the radius of interaction."""
        q = self.pairs.distance / self.flow.cutoff
        return torch.clamp(1 - q * q, min=0) ** 2

    def invariants(self, names: Sequence[str], symmetric: bool) -> Tensor:
        """Return the inputs `names` of a network for each pair, (features, m), in the order of `scene.terms.INPUTS`.

        "density" gives two features: rho'_i and rho'_j, or, if `symmetric`, rho'_i + rho'_j and (rho'_i - rho'_j)^2.
        The symmetric features are equal for (i, j) and (j, i). All other features are always symmetric.
        """
        features: list[Tensor] = []
        if "density" in names:
            own, other = self.densities
            features += [own + other, (own - other).square()] if symmetric else [own, other]
        if "distance" in names:
            features.append(self.distance)
        if "speed" in names:
            features.append(safe_norm(self.v))
        if "approach" in names:
            features.append(self.approach)
        return torch.stack(features)


@dataclass(frozen=True)
class CompiledSum:
    """A term's sum over pairs in the form of the compiled library.

    Parameters
    ----------
    kind, numbers : name and constants of the sum in the library (kernels/summands.hpp).
    parameters : (p,), parameters of the sum, differentiable; none by default.
    scalars : columns (s,) of all particles that this rank sees, differentiable.
    reads_velocity : whether the sum needs the velocities of the particles.
    """

    kind: str
    numbers: tuple[float, ...] = ()
    parameters: Tensor | None = None
    scalars: tuple[Tensor, ...] = ()
    reads_velocity: bool = True


def compiled_sums(space: PairSpace, summands: Sequence[CompiledSum], parities: Sequence[Tensor], position: Tensor,
                  velocity: Tensor | None, wanted: np.ndarray, dtype: torch.dtype) -> tuple[Tensor, ...]:
    """Return the sums (components, s) of each summand over the neighbours of the particles `wanted`, bool (s,).

    The sums of other particles are undefined. `parities` are the `parity` of each PairSum. `position` and `velocity`
    (s, 3) belong to all particles that this rank sees. `dtype` is the precision of the arithmetic. Differentiable.
    Raises ValueError if a position is not finite.
    """
    columns: list[Tensor] = []
    placed = []
    for summand, parity in zip(summands, parities, strict=True):
        # Summands with the same columns share them.
        shared = next((place for place in range(len(columns) - len(summand.scalars) + 1)
                       if all(a is b for a, b in zip(columns[place:], summand.scalars))), len(columns))
        if shared == len(columns):
            columns += summand.scalars
        placed.append(Summand(summand.kind, summand.numbers, tuple(parity.tolist()), shared))
    scalars = torch.stack(columns).double() if columns else position.new_zeros(0, len(position))
    velocity = torch.zeros_like(position) if velocity is None else velocity
    return _PairSums.apply(space, placed, wanted, dtype, position, velocity, scalars,
                           *(position.new_empty(0) if summand.parameters is None else summand.parameters
                             for summand in summands))


class _PairSums(torch.autograd.Function):
    """The sums of `compiled_sums`, by the compiled library. The backward pass evaluates all pairs again."""

    @staticmethod
    def forward(ctx, space: PairSpace, summands: list[Summand], wanted: np.ndarray, dtype: torch.dtype,
                position: Tensor, velocity: Tensor, scalars: Tensor, *parameters: Tensor) -> tuple[Tensor, ...]:
        kind = np.dtype(str(dtype).removeprefix("torch."))
        ctx.pairs = CompiledPairs(space, *map(as_numpy, (position, velocity, scalars)), wanted, kind)
        ctx.summands = summands
        ctx.save_for_backward(position, velocity, scalars, *parameters)
        return tuple(map(torch.from_numpy, ctx.pairs.sums(summands, list(map(as_numpy, parameters)))))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *by_sums: Tensor) -> tuple[Tensor | None, ...]:
        inputs = ctx.saved_tensors
        by_parameters, by_columns = ctx.pairs.gradients(ctx.summands, list(map(as_numpy, inputs[3:])),
                                                        [by.numpy() for by in by_sums], any(ctx.needs_input_grad[4:7]))
        gradients = [*(by_columns or (None, None, None)), *by_parameters]
        return (None, None, None, None, *(None if by is None else torch.from_numpy(by).to(tensor)
                                          for by, tensor in zip(gradients, inputs)))
