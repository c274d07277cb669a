"""Compiled sums over pairs, and gradients through them, against torch."""

import ctypes
import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from eddies.kernels.pairs import CompiledPairs, PairSpace, Summand
from eddies.kernels.reconstruction import kernel_numbers
from eddies.particles import context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.pairs import compiled_sums
from eddies.particles.smoothing_kernels import CubicSpline
from eddies.particles.terms.term import PairTerm
from tests.particles.configurations import (
    CONFIGURATIONS, CUTOFF, FLOW, LENGTH, NEIGHBORS, OPEN, PAIR_MODELS, SCALES, alone, by_torch, dynamics_of, given,
    model, state,
)

# Every term over pairs, with every choice of its settings.
TERMS = {name: PAIR_MODELS[name] for name in ("published", "corrected", "antisymmetric", "without density")} | {
    "wide and deep": {"pairs": dict(hidden=(7, 33, 4)), "density-flux": dict(hidden=(9,)), "density-diffusion": {}},
    "unit vectors in a window": {"pairs": dict(basis="unit"), "eddy-viscosity": dict(basis="unit", form="monaghan"),
                                 "density-flux": dict(sign=True, inputs=("distance",))},
    "vectors without a window": {"pairs": dict(basis="paper", **OPEN), "eddy-viscosity": dict(basis="paper", **OPEN)},
    "sph": {"continuity": {}, "wcsph": {}, "transport-velocity": {}},
    "transport velocity alone": {"transport-velocity": {}},
}


def set_up(terms, kind, cutoff=CUTOFF, count=128, dtype=torch.float64):
    flow = FlowUnits(SCALES, cutoff, NEIGHBORS) if cutoff != CUTOFF else FLOW
    slab, particles = alone(*state(count, kind=kind))
    lagrangian = model(terms, flow).to(dtype)
    return dynamics_of(slab, lagrangian, skin=0.05, dtype=dtype), particles


def rates_and_gradients(dynamics, particles, rows=None):
    """Rates by name, and the gradient of a number that depends on all of them by parameters and the particles."""
    columns = {name: column.clone().requires_grad_() for name, column in particles.columns().items() if name != "id"}
    rates = given(dynamics.rates(replace(particles, **columns), rows))
    random = torch.Generator().manual_seed(5)
    total = sum((rate.double() * torch.randn(rate.shape, generator=random, dtype=torch.float64)).sum()
                for rate in rates.values())
    inputs = [*columns.values(), *dynamics.model.parameters()]
    gradients = torch.autograd.grad(total, inputs, allow_unused=True, materialize_grads=True)
    return [rate.detach() for rate in rates.values()] + list(gradients)


def compare(monkeypatch, dynamics, particles, relative, rows=None):
    compiled = rates_and_gradients(dynamics, particles, rows)
    with monkeypatch.context() as other:
        by_torch(other)
        expected = rates_and_gradients(dynamics, particles, rows)
    assert len(compiled) == len(expected)
    for one, other in zip(compiled, expected):
        assert one.dtype == other.dtype and one.shape == other.shape
        assert (one - other).abs().max() <= relative * other.abs().max() + 1e-13


def summands_of(dynamics, particles):
    """The summand of each term over pairs of a model, and of the moments, with the term."""
    given = dynamics.context(particles)
    terms = [*(term for term in dynamics.model.terms.values() if isinstance(term, PairTerm)), context._MOMENTS]
    return [(term.compiled(given), term) for term in terms]


# Every term at random places, and one model in every configuration. Where particles coincide the gradient of a force is
# 0/0 in torch, so that terms that derive a kernel are left out there.
CASES = [(name, "even") for name in TERMS] + [("published", kind) for kind in CONFIGURATIONS if kind != "even"]


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name, kind", CASES)
def test_sums_and_gradients_are_those_of_torch(comm, library, monkeypatch, name, kind):
    compare(monkeypatch, *set_up(TERMS[name], kind), 1e-11, rows=torch.arange(3, 128, 7))
    compare(monkeypatch, *set_up(TERMS[name], kind), 1e-11)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("cutoff", [3.0, 2.2, 0.7])
def test_with_any_number_of_rows_of_cells(comm, library, monkeypatch, cutoff):
    """The box is at most one or two rows of cells across, or many; three with the other tests' cutoff."""
    compare(monkeypatch, *set_up(PAIR_MODELS["corrected"], "uneven", cutoff), 1e-11)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name", ["published", "antisymmetric", "sph"])
def test_single_precision_differs_by_its_rounding(comm, library, monkeypatch, name):
    """A sum has up to a hundred pairs of either sign, each rounded several times."""
    compare(monkeypatch, *set_up(TERMS[name], "even", dtype=torch.float32), 3e-5)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name", TERMS)
def test_gradients_are_those_of_differences(comm, name):
    """Gradients by positions, velocities, scalars and parameters, for every summand that has them. The test above
    compares all instruction sets."""
    dynamics, particles = set_up(TERMS[name], "cluster across a corner", count=14)
    for summand, term in summands_of(dynamics, particles):
        parameters = torch.empty(0, dtype=torch.float64) if summand.parameters is None else summand.parameters
        inputs = [value.detach().clone().requires_grad_() for value in
                  (particles.position, particles.velocity, parameters, *summand.scalars)]
        for mutual in {False, term.mutual}:
            space = PairSpace(LENGTH, True, CUTOFF, SCALES.filter_width, SCALES.velocity, mutual)

            def number(position, velocity, parameters, *scalars):
                given = replace(summand, parameters=parameters, scalars=scalars)
                sums, = compiled_sums(space, [given], [term.parity], position, velocity, np.ones(14, bool),
                                      torch.float64)
                return (sums * torch.linspace(1, 2, sums.numel()).reshape(sums.shape)).sum() / scale

            scale = 1.0
            scale = max(float(by.abs().max()) for by in torch.autograd.grad(number(*inputs), inputs) if by.numel())
            # Errors of differences are of second order, and round-off over the step.
            assert scale > 0 and torch.autograd.gradcheck(number, inputs, eps=1e-6, atol=1e-8, rtol=1e-6)


@pytest.mark.mpi(1)
def test_every_summand_of_the_library_belongs_to_a_term(comm, library):
    library.pair_summand.restype = ctypes.c_char_p
    numbers = map(ctypes.c_int64, itertools.count())
    names = itertools.takewhile(bool, map(library.pair_summand, numbers))
    used = {summand.kind for terms in TERMS.values() for summand, _ in summands_of(*set_up(terms, "even"))}
    assert used | {"kernel-sum", "kernel-average"} == {name.decode() for name in names}


def pairs_of(position, radius, wanted=None, scalars=(), dtype=np.float64, mutual=True):
    count = len(position)
    return CompiledPairs(PairSpace(LENGTH, True, radius, 1.0, 1.0, mutual), position, np.zeros((count, 3)),
                         np.reshape(scalars, (-1, count)) if count else np.zeros((0, 0)),
                         np.ones(count, bool) if wanted is None else wanted, dtype)


@pytest.mark.parametrize("kind, numbers, components, parameters, scalar", [
    ("unheard-of", (), 1, 0, 0), ("moments", (), 6, 0, 0), ("moments", (), 7, 1, 0),
    ("wcsph", (1.0, 1.0, 0.1), 3, 2, 1), ("pair-network", (2, 0, 0, 1, 0, 0, 0, 1, 0, 3), 6, 13, 0)])
def test_summands_with_other_arguments_are_refused(library, kind, numbers, components, parameters, scalar):
    pairs = pairs_of(np.zeros((2, 3)), 1.0, scalars=np.zeros((2, 2)))
    with pytest.raises(ValueError, match=kind):
        pairs.sums([Summand(kind, numbers, (1.0,) * components, scalar)], [np.zeros(parameters)])


@pytest.mark.parametrize("dtype, error", [(np.float32, 6e-7), (np.float64, 1e-15)], ids=["single", "double"])
def test_tanh_of_a_network(library, dtype, error):
    """The fit in single precision is good to 4e-7. In double precision tanh is rounded as a sum with 1 is."""
    corner = np.indices((10, 10, 10)).reshape(3, -1).T * LENGTH / 10
    number = np.linspace(-12, 12, 2 * len(corner)).astype(dtype)
    number[:8] = 0, 1e-30, -1e-30, 1e-4, 1e4, -1e4, 7.999, 8.001
    # Each particle has one neighbour; one layer of one number outputs the tanh of the particle's own scalar.
    pairs = pairs_of(np.concatenate([corner, corner + 0.1]), 0.2, scalars=number.astype(float), dtype=dtype,
                     mutual=False)
    network = Summand("pair-network", (1, 0, 1, 0, 0, 0, 0, 0, 0, 1), (1.0,))
    tanh = pairs.sums([network], [np.array([1.0, 0, 0, 1, 0])])[0][0]
    assert np.abs(tanh - np.tanh(number.astype(float))).max() <= error and np.abs(tanh).max() <= 1


KERNEL_SUM = Summand("kernel-sum", kernel_numbers(CUTOFF, CubicSpline(CUTOFF).pieces.numpy()), (1.0,))


def kernel_sums(position, **options):
    """The sum of a kernel over the neighbours of each particle."""
    return pairs_of(position, CUTOFF, **options).sums([KERNEL_SUM], [np.zeros(0)])[0][0]


def value(distance):
    return float(CubicSpline(CUTOFF).value(torch.tensor(distance, dtype=torch.float64)))


def test_ten_thousand_particles_in_one_place(library):
    sums = kernel_sums(np.full((10000, 3), 3.1), wanted=np.arange(10000) % 4000 == 7)
    assert sums[7::4000] == pytest.approx([9999 * value(0.0)] * 3, rel=1e-12)


def test_a_pair_across_every_face_edge_and_corner(library):
    ends = 1e-9 + np.indices((2, 2, 2)).reshape(3, -1).T * (LENGTH - 2e-9)
    for direction in np.eye(3):
        for end in ends:
            sums = kernel_sums(np.array([end - CUTOFF / 4 * direction, end + CUTOFF / 4 * direction]))
            assert sums == pytest.approx([value(CUTOFF / 2)] * 2, rel=1e-9)


def test_without_pairs_sums_are_zero(library):
    for count in (0, 1):
        assert np.array_equal(kernel_sums(np.full((count, 3), 0.2)), np.zeros(count))


def test_positions_that_are_not_finite_and_missing_gradients_are_refused(library):
    for wrong in (np.nan, np.inf):
        position = np.random.default_rng(1).uniform(0, LENGTH, (20, 3))
        position[7, 1] = wrong
        with pytest.raises(ValueError, match="particle 7"):
            kernel_sums(position)
    with pytest.raises(ValueError, match="gradient"):
        pairs_of(np.zeros((2, 3)), 1.0).gradients([KERNEL_SUM], [np.zeros(0)], [np.zeros((1, 2))], True)
