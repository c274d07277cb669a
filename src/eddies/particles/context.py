"""Context of an evaluation: the quantities that terms may use, each computed at its first use and then shared."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from eddies.import_path import users_code
from eddies.kernels.pairs import PairSpace
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.devices import kernels_serve
from eddies.particles.exchanges import mean_over_ranks
from eddies.particles.flow_units import FlowUnits
from eddies.particles.kriging import Kriging
from eddies.particles.neighborhood import LocalParticles
from eddies.particles.pairs import CompiledSum, ScaledPairs, compiled_sums
from eddies.particles.particle_set import ParticleSet
from eddies.particles.rates import described
from eddies.particles.resolved_velocity import ResolvedFlow, ResolvedVelocity
from eddies.scene.terms import TermError

# By device: how many numbers sums over pairs hold in memory at once if no gradient is recorded. They fit the cache of a
# core, or a part of the memory of a GPU.
PAIR_VALUES_TOGETHER = {"cpu": 1 << 19, "cuda": 1 << 26}
# This fraction of the values for evenly spread neighbours is added to moment matrices and sums of weights. They can
# then be inverted even without neighbours or with only coplanar ones. In all other cases the bias is 0.1 %.
REGULARISATION = 1e-3
# Indices of the six entries of a symmetric 3 x 3 matrix: xx, xy, xz, yy, yz, zz.
ENTRIES = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
UNDECLARED = 'the term uses "{}", which no term of this model declares; add it to `reads` of its settings'


class PairSum:
    """A sum of `pair_values` over the neighbours within the radius of interaction.

    Attributes
    ----------
    width : largest number of values that a pair needs at once; it determines how many pairs are evaluated together.
    mutual : whether the values of pair (j, i) are `parity` times those of (i, j). Each pair is then evaluated once.
    parity : (components,), 1 or -1 for each component.
    needs_moments : whether the sums are used together with `context.moments`.
    """

    width = 8
    mutual = False
    needs_moments = False
    parity: Tensor = torch.ones(1)

    def pair_values(self, pairs: ScaledPairs) -> Tensor:
        """Values to sum over neighbours, (components, m). They must vanish beyond the radius of interaction."""
        raise TermError(f"{type(self).__name__}: has no pair_values(pairs); define it, and let it return "
                        "(components, m)")

    def compiled(self, context: Context) -> CompiledSum | None:
        """Return the same sum for the compiled library, or None without one.

        A subclass does not inherit this method: if it does not define its own, torch computes its sum.
        """
        return None


@dataclass(frozen=True)
class Moments:
    """Moments of the neighbourhoods of k particles: `inverse` (6, k) of sum_j w x x^T, and `weight` (1, k), sum_j w."""

    inverse: Tensor
    weight: Tensor


class Context:
    """One evaluation of the terms of a model at given particles.

    Parameters
    ----------
    decomposition : slabs, with the communicator.
    particles : the owned particles.
    flow : units of the model.
    local : the s particles that this rank sees, owned ones and ghosts; None if no term reads pairs.
    resolution : finds the resolved velocity; None if no term reads it.
    rows : (k,), the requested particles, for which rates are computed; None: all.
    dtype : floating-point type of computations with pairs; None: that of the positions.
    density : (n,), density of the particles; None if terms give it, or if no term reads it.
    time : time of the evaluation in a run. The solve for the resolved velocity starts from a prediction for this time;
        None: no prediction.
    """

    def __init__(self, decomposition: SlabDecomposition, particles: ParticleSet, flow: FlowUnits,
                 local: LocalParticles | None, resolution: ResolvedVelocity | None, rows: Tensor | None = None,
                 dtype: torch.dtype | None = None, density: Tensor | None = None, time: float | None = None) -> None:
        self.decomposition, self.comm = decomposition, decomposition.comm
        self.particles, self.flow, self.rows, self.density = particles, flow, rows, density
        self.dtype = dtype or particles.position.dtype
        self._local, self._resolution, self._time = local, resolution, time
        self._columns: dict[str, Tensor] = {}
        self._sums: dict[PairSum, Tensor] = {}

    @property
    def local(self) -> LocalParticles:
        if self._local is None:
            raise TermError(UNDECLARED.format("pairs"))
        return self._local

    @property
    def kriging(self) -> Kriging:
        """Kriging among neighbours at all owned particles; collective."""
        return self.local.kriging(self.flow.scales.filter_width, self.dtype)

    @property
    def everywhere(self) -> Context:
        """The same context with all owned particles as the requested ones."""
        return self if self.rows is None else self.of_rows(None)

    def of_rows(self, rows: Tensor | None) -> Context:
        """Return the same context with other requested particles; None: all owned ones."""
        other = copy(self)
        other.rows, other._sums = rows, {}
        vars(other).pop("moments", None)
        return other

    def column(self, name: str) -> Tensor:
        """Return the column "velocity" (s, 3) or "density" (s,) of owned particles, then of ghosts; collective."""
        around = self.local.neighborhood
        if name not in self._columns:
            owned = self.density if name == "density" else getattr(self.particles, name)
            if owned is None:
                raise TermError(UNDECLARED.format(name) + f"; or the particles have no {name}")
            self._columns[name] = around.column(owned)
        return self._columns[name]

    @property
    def own_density(self) -> Tensor:
        """Density (k,) of the requested particles."""
        density = self.column("density")[: len(self.particles)]
        return density if self.rows is None else density[self.rows]

    @property
    def density_fluctuation(self) -> Tensor:
        """rho' = (rho - rho_0)/rho_rms of the particles that this rank sees, (s,); collective."""
        name, scales = "density fluctuation", self.flow.scales
        if name not in self._columns:
            self._columns[name] = (self.column("density") - scales.density_mean) / scales.required("density")
        return self._columns[name]

    @cached_property
    def resolved(self) -> ResolvedFlow:
        """The velocity that the particles resolve; collective."""
        if self._resolution is None:
            raise TermError(UNDECLARED.format("resolved"))
        return self._resolution.of(self.particles, self._time)

    def without_mean(self, rows: Tensor) -> Tensor:
        """Subtract from rows (n, c) of the owned particles the mean row over the particles of all ranks; collective."""
        return rows - mean_over_ranks(self.comm, rows)

    # ---- sums over pairs

    def pair_sums(self, term: PairSum) -> Tensor:
        """Return the sums (components, k) of a term over the neighbours of each requested particle; collective."""
        if term not in self._sums:
            self.sum_pairs([term])
        return self._sums[term]

    def forget_sums(self, term: object) -> None:
        """Discard a term's sums over pairs after a change of its parameters."""
        self._sums = {summand: sums for summand, sums in self._sums.items() if summand is not term}

    @cached_property
    def moments(self) -> Moments:
        """Moments of the neighbourhoods, regularised so that they can be inverted even without any neighbour."""
        sums, flow = self.pair_sums(_MOMENTS), self.flow
        expected = expected_moment(flow.neighbors, flow.cutoff / flow.scales.filter_width)
        diagonal = sums.new_tensor([1, 0, 0, 1, 0, 1]).unsqueeze(1)
        return Moments(invert_symmetric(sums[1:] + REGULARISATION * expected * diagonal),
                       sums[:1] + REGULARISATION * expected_weight(flow.neighbors))

    def sum_pairs(self, terms: Sequence[PairSum]) -> None:
        """Compute and store the sums of several terms together, and the moments if a term needs them; collective."""
        needs_moments = any(term.needs_moments for term in terms)
        summands = [each for each in (*terms, *([_MOMENTS] if needs_moments else [])) if each not in self._sums]
        if not summands:
            return
        requests = {summand: self._compiled_request(summand) for summand in summands}
        if compiled := {summand: request for summand, request in requests.items() if request is not None}:
            self._sums |= zip(compiled, self._compiled_sums(compiled))
        if rest := [summand for summand in summands if requests[summand] is None]:
            self._sums |= zip(rest, self._torch_sums(rest))

    def _compiled_request(self, summand: PairSum) -> CompiledSum | None:
        """Return a sum in the form of the compiled library.

        The result is None if the sum has no compiled form, or if the library does not support the device.
        """
        request = vars(type(summand)).get("compiled")
        return request(summand, self) if request and kernels_serve(self.particles.position.device) else None

    def _compiled_sums(self, summands: Mapping[PairSum, CompiledSum]) -> list[Tensor]:
        mutual = self.rows is None and all(summand.mutual for summand in summands)
        local, flow, owned = self.local, self.flow, len(self.particles)
        wanted = np.zeros(len(local.position), bool)
        wanted[slice(owned) if self.rows is None else self.rows.numpy()] = True
        box = local.neighborhood.box
        space = PairSpace(box.length, box.periodic_z, flow.cutoff, flow.scales.filter_width, flow.scales.velocity,
                          mutual)
        velocity = self.column("velocity") if any(each.reads_velocity for each in summands.values()) else None
        sums = compiled_sums(space, list(summands.values()), [summand.parity for summand in summands], local.position,
                             velocity, wanted, self.dtype)
        return [each[:, :owned] if self.rows is None else each.index_select(1, self.rows) for each in sums]

    def _torch_sums(self, summands: Sequence[PairSum]) -> Sequence[Tensor]:
        together = self.rows is not None or torch.is_grad_enabled()
        blocks = []
        for pairs in [self._pairs(self.rows)] if together else self.pairs_in_blocks(max(s.width for s in summands)):
            values = [_values(summand, pairs) for summand in summands]
            blocks.append(pairs.pairs.sum(torch.cat(values)))
        return torch.cat(blocks, dim=1).split([len(value) for value in values])

    def _pairs(self, block: Tensor | slice | None) -> ScaledPairs:
        position = self.local.position
        pairs = self.local.neighbors.pairs(position[: len(self.particles)], position, block, self.dtype)
        return ScaledPairs(pairs, self.column, self.flow)

    def pairs_in_blocks(self, width: int) -> Iterator[ScaledPairs]:
        """Yield all pairs, in both orders, in one or more blocks. A block has the pairs of consecutive particles.

        With `width` numbers per pair, each block has about PAIR_VALUES_TOGETHER numbers.
        """
        together = max(PAIR_VALUES_TOGETHER[self.particles.position.device.type] // width, 1)
        for block in self.local.neighbors.blocks(together):
            yield self._pairs(block)


def _values(summand: PairSum, pairs: ScaledPairs) -> Tensor:
    """Return the values (components, m) of a summand for m pairs. Raises TermError, which names the class, if
    `pair_values` fails or returns anything but real numbers of this shape."""
    with users_code(type(summand), TermError):
        values = summand.pair_values(pairs)
    count = len(pairs.pairs.distance)
    if not isinstance(values, Tensor) or values.dim() != 2 or values.shape[1] != count or values.is_complex():
        raise TermError(f"{type(summand).__name__}: pair_values returns {described(values)}; it must return real "
                        f"numbers of shape (components, {count}): a column for each pair")
    return values


class _SharedMoments(PairSum):
    """The sums of `Moments`: w, then the entries of w x x^T."""

    mutual, parity = True, torch.ones(7)

    def pair_values(self, pairs: ScaledPairs) -> Tensor:
        return torch.stack([pairs.weight, *products(pairs.weight * pairs.x, pairs.x)])

    def compiled(self, context: Context) -> CompiledSum:
        return CompiledSum("moments", reads_velocity=False)


_MOMENTS = _SharedMoments()


def expected_weight(neighbors: float) -> float:
    """Return the sum of w over `neighbors` evenly spread particles within the cutoff. Each adds
    3 int q^2 w dq = 8/35."""
    return neighbors * 8 / 35


def expected_moment(neighbors: float, cutoff: float) -> float:
    """Return a diagonal entry of sum w x x^T for evenly spread neighbours. Each adds
    cutoff^2 int q^4 w dq = 8/315 cutoff^2."""
    return neighbors * cutoff**2 * 8 / 315


def products(a: Tensor, b: Tensor) -> list[Tensor]:
    """Return the six entries a_i b_j, each (m,), of a b^T for parallel vectors a, b (3, m). So a b^T is symmetric."""
    return [a[i] * b[j] for i, j in ENTRIES]


def invert_symmetric(matrix: Tensor) -> Tensor:
    """Return the inverses (6, n) of n symmetric positive definite 3 x 3 matrices, given by their six entries (6, n)."""
    xx, xy, xz, yy, yz, zz = matrix
    cofactors = torch.stack([yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy, xx * zz - xz * xz,
                             xy * xz - xx * yz, xx * yy - xy * xy])
    return cofactors / (xx * cofactors[0] + xy * cofactors[1] + xz * cofactors[2])


def apply_symmetric(matrix: Tensor, vectors: Tensor) -> Tensor:
    """Return the products of symmetric matrices (6, n) with vectors (3, n): (3, n)."""
    xx, xy, xz, yy, yz, zz = matrix
    x, y, z = vectors
    return torch.stack([xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z])
