"""Sums over pairs by the compiled library as differentiable operations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from eddies.kernels.library import library
from eddies.kernels.pairs import CompiledPairs, PairSpace, Summand


@dataclass(frozen=True)
class CompiledSum:
    """What a term sums over pairs, as the library is told of it.

    Parameters
    ----------
    kind : its name in the library (kernels/summands.hpp). numbers : that it takes there.
    parameters : (p,), differentiable; none unless given.
    scalars : columns (s,) of all particles that this rank sees, likewise.
    reads_velocity : whether velocities matter.
    """

    kind: str
    numbers: tuple[float, ...] = ()
    parameters: Tensor | None = None
    scalars: tuple[Tensor, ...] = ()
    reads_velocity: bool = True


def compiled_sums(space: PairSpace, summands: Sequence[CompiledSum], parities: Sequence[Tensor], position: Tensor,
                  velocity: Tensor | None, wanted: np.ndarray, dtype: torch.dtype) -> tuple[Tensor, ...]:
    """The sums (components, s) of each summand at the particles `wanted`, bool (s,), over those within the radius;
    elsewhere they mean nothing. Differentiable.

    Parameters
    ----------
    parities : of each summand, (components,), as those of pair terms.
    position, velocity : (s, 3), of all particles that this rank sees; no velocity where no summand reads it.
    dtype : of the arithmetic.

    Raises ValueError where a position is not finite.
    """
    columns: list[Tensor] = []
    placed = []
    for summand, parity in zip(summands, parities, strict=True):
        known = next((place for place in range(len(columns) - len(summand.scalars) + 1)
                      if all(a is b for a, b in zip(columns[place:], summand.scalars))), len(columns))
        if known == len(columns):
            columns += summand.scalars
        placed.append(Summand(summand.kind, summand.numbers, tuple(parity.tolist()), known))
    scalars = torch.stack(columns).double() if columns else position.new_zeros(0, len(position))
    velocity = torch.zeros_like(position) if velocity is None else velocity
    return _PairSums.apply(space, placed, wanted, dtype, position, velocity, scalars,
                           *(position.new_empty(0) if summand.parameters is None else summand.parameters
                             for summand in summands))


class _PairSums(torch.autograd.Function):
    """The sums; on the way back all pairs are evaluated anew."""

    @staticmethod
    def forward(ctx, space: PairSpace, summands: list[Summand], wanted: np.ndarray, dtype: torch.dtype,
                position: Tensor, velocity: Tensor, scalars: Tensor, *parameters: Tensor) -> tuple[Tensor, ...]:
        kind = np.dtype(str(dtype).removeprefix("torch."))
        ctx.pairs = CompiledPairs(library(), space, *map(_numbers, (position, velocity, scalars)), wanted, kind)
        ctx.summands = summands
        ctx.save_for_backward(position, velocity, scalars, *parameters)
        return tuple(map(torch.from_numpy, ctx.pairs.sums(summands, list(map(_numbers, parameters)))))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *by_sums: Tensor) -> tuple[Tensor | None, ...]:
        columns = any(ctx.needs_input_grad[4:7])
        given = ctx.saved_tensors
        by_parameters, by_columns = ctx.pairs.gradients(ctx.summands, list(map(_numbers, given[3:])),
                                                        [by.numpy() for by in by_sums], columns)
        found = [*(by_columns or (None, None, None)), *by_parameters]
        return (None, None, None, None, *(None if by is None else torch.from_numpy(by).to(tensor)
                                          for by, tensor in zip(found, given)))


def _numbers(tensor: Tensor) -> np.ndarray:
    return tensor.detach().numpy()
