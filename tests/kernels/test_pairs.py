"""Compiled sums over pairs against those of torch, for each instruction set that this processor runs."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from eddies.kernels.pairs import CompiledPairs, PairSpace, Summand, kinds
from eddies.kernels.reconstruction import told_kernel
from eddies.particles import context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.model import TERMS as BUILT_IN
from eddies.particles.pairs import compiled_sums
from eddies.particles.smoothing_kernels import CubicSpline, WendlandC2
from eddies.particles.terms.term import PairTerm
from tests.particles.configurations import (
    CONFIGURATIONS, CUTOFF, FLOW, LENGTH, NEIGHBORS, OPEN, PAIR_MODELS, SCALES, alone, by_torch, dynamics_of, given,
    model, state,
)

# Every term over pairs as it is without settings, and others.
TERMS = {word: {word: {}} for word, kind in BUILT_IN.items() if issubclass(kind, PairTerm)} | PAIR_MODELS | {
    "wide and deep": {"pairs": dict(hidden=(7, 33, 4)), "density-flux": dict(hidden=(9,))},
    "flux and friction": {"pairs": {}, "density-flux": {}, "eddy-viscosity": dict(form="monaghan")},
    "antisymmetric alone": {"pairs": dict(basis="paper", symmetry="antisymmetric")},
    "two-sided": {"eddy-viscosity": dict(form="two-sided", basis="paper")},
    "unit vectors in a window": {"pairs": dict(basis="unit"), "eddy-viscosity": dict(basis="unit", form="monaghan"),
                                 "density-flux": dict(sign=True, inputs=("distance",))},
    "vectors without": {"pairs": dict(basis="paper", **OPEN), "eddy-viscosity": dict(basis="paper", **OPEN)},
    "continuity": {"continuity": dict(diffusion=0.1), "wcsph": {}},
    "transport velocity": {"continuity": {}, "wcsph": {}, "transport-velocity": {}},
    "transport velocity alone": {"transport-velocity": {}},
}
# Of at most 1, 2 or 3 rows of cells across, and of many.
CUTOFFS = {"large": 3.0, "half": 2.2, "third": CUTOFF, "small": 0.7}


@pytest.fixture
def served(library, monkeypatch):
    """Let dynamics use that library."""
    monkeypatch.setattr("eddies.particles.pairs.library", lambda: library)


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


def assert_same(found, expected, relative):
    assert len(found) == len(expected)
    for one, other in zip(found, expected):
        assert one.dtype == other.dtype and one.shape == other.shape
        assert (one - other).abs().max() <= relative * other.abs().max() + 1e-13


def compare(monkeypatch, dynamics, particles, relative, rows=None):
    found = rates_and_gradients(dynamics, particles, rows)
    with monkeypatch.context() as other:
        by_torch(other)
        expected = rates_and_gradients(dynamics, particles, rows)
    assert_same(found, expected, relative)


def told(dynamics, particles):
    """What the library is told of each term over pairs of a model, and of the moments, with its parity."""
    given = dynamics.context(particles)
    terms = [*(term for term in dynamics.model.terms.values() if isinstance(term, PairTerm)), context._MOMENTS]
    return [(term.compiled(given), term) for term in terms]


# The gradient of a force of particles in one place, W'(r)/r x, is what torch's quotient 0/0 does not tell.
CASES = [(name, kind) for name in TERMS for kind in CONFIGURATIONS
         if not (kind == "coincident" and {"continuity", "wcsph", "transport-velocity"} & set(TERMS[name]))]


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name, kind", CASES)
def test_sums_and_gradients_are_those_of_torch(comm, served, monkeypatch, name, kind):
    dynamics, particles = set_up(TERMS[name], kind)
    compare(monkeypatch, dynamics, particles, 1e-11)
    compare(monkeypatch, dynamics, particles, 1e-11, rows=torch.arange(3, 128, 7))


@pytest.mark.mpi(1)
@pytest.mark.parametrize("cutoff", CUTOFFS.values(), ids=CUTOFFS)
@pytest.mark.parametrize("kind", ["even", "uneven"])
def test_with_any_number_of_rows_of_cells(comm, served, monkeypatch, kind, cutoff):
    compare(monkeypatch, *set_up(PAIR_MODELS["corrected"], kind, cutoff), 1e-11)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name", ["corrected", "published", "antisymmetric", "continuity"])
def test_single_precision_differs_by_its_rounding(comm, served, monkeypatch, name):
    """Sums of up to a hundred pairs of either sign, of which each is rounded several times."""
    compare(monkeypatch, *set_up(TERMS[name], "even", dtype=torch.float32), 3e-5)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name", TERMS)
def test_gradients_are_those_of_differences(comm, served, name):
    """By positions, velocities, numbers of particles and parameters, of every summand of the library that has one: one
    that is new is among them, as terms are."""
    dynamics, particles = set_up(TERMS[name], "cluster across a corner", count=14)
    for summand, term in told(dynamics, particles):
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
            # Differences are of second order, and of round-off over the step.
            assert scale > 0 and torch.autograd.gradcheck(number, inputs, eps=1e-6, atol=1e-8, rtol=1e-6)


@pytest.mark.mpi(1)
def test_every_summand_with_a_gradient_is_one_of_a_term(comm, library):
    found = {summand.kind for terms in TERMS.values() for summand, _ in told(*set_up(terms, "even"))}
    assert found | {"kernel-sum", "kernel-average"} == set(kinds(library))


@pytest.mark.parametrize("kind, numbers, parity, parameters, scalar", [
    ("unheard-of", (), 1, 0, 0), ("moments", (), 6, 0, 0), ("moments", (), 7, 1, 0),
    ("wcsph", (1.0, 1.0, 0.1), 3, 2, 1), ("pair-network", (2, 0, 0, 1, 0, 0, 0, 1, 0, 3), 6, 13, 0)])
def test_what_a_summand_does_not_take_is_told(library, kind, numbers, parity, parameters, scalar):
    """A name, components, parameters and columns of numbers."""
    space = PairSpace(LENGTH, True, 1.0, 1.0, 1.0, mutual=False)
    pairs = CompiledPairs(library, space, np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 2)), np.ones(2, bool),
                          np.float64)
    with pytest.raises(ValueError, match=f"no such summands.*{kind}"):
        pairs.sums([Summand(kind, numbers, (1.0,) * parity, scalar)], [np.zeros(parameters)])


@pytest.mark.parametrize("dtype, error", [(np.float32, 6e-7), (np.float64, 1e-15)], ids=["single", "double"])
def test_tanh_of_a_network(library, dtype, error):
    """Of numbers that particles carry, each with one neighbour: a fit to 4e-7 and its round-off; to that of a sum with
    1 in double precision."""
    corner = np.indices((10, 10, 10)).reshape(3, -1).T * LENGTH / 10
    position = np.concatenate([corner, corner + 0.1])
    number = np.linspace(-12, 12, len(position)).astype(dtype)
    number[:8] = 0, 1e-30, -1e-30, 1e-4, 1e4, -1e4, 7.999, 8.001
    space = PairSpace(LENGTH, True, 0.2, 1.0, 1.0, mutual=False)
    pairs = CompiledPairs(library, space, position, np.zeros_like(position), number[None].astype(float),
                          np.ones(len(position), bool), dtype)
    # One output of a layer of one, that is told both numbers and takes that of the particle itself.
    network = Summand("pair-network", (1, 0, 1, 0, 0, 0, 0, 0, 0, 1), (1.0,))
    found = pairs.sums([network], [np.array([1.0, 0, 0, 1, 0])])[0][0]
    expected = np.tanh(number.astype(float))
    assert np.abs(found - expected).max() <= error and np.abs(found).max() <= 1


def kernel_sum(kernel):
    return Summand("kernel-sum", told_kernel(kernel.support, kernel.pieces.numpy()), (1.0,))


def sums(library, position, radius=CUTOFF, wanted=None, dtype=np.float64):
    """Of a cubic spline that ends at the radius."""
    space = PairSpace(LENGTH, True, radius, 1.0, 1.0, mutual=True)
    wanted = np.ones(len(position), bool) if wanted is None else wanted
    pairs = CompiledPairs(library, space, position, np.zeros_like(position), np.zeros((0, len(position))), wanted,
                          dtype)
    return pairs.sums([kernel_sum(CubicSpline(radius))], [np.zeros(0)])[0][0]


def value(kernel, distance, support=CUTOFF):
    return float(kernel(support).value(torch.tensor(distance, dtype=torch.float64)))


def test_ten_thousand_particles_in_one_place(library):
    """Of which three ask for their sums."""
    found = sums(library, np.full((10000, 3), 3.1), wanted=np.arange(10000) % 4000 == 7)
    assert found[7::4000] == pytest.approx([9999 * value(CubicSpline, 0.0)] * 3, rel=1e-12)


def test_a_pair_across_every_face_edge_and_corner(library):
    """Half a radius apart, wherever it is in the box; particles that lie whole periods away are the same."""
    ends = 1e-9 + np.indices((2, 2, 2)).reshape(3, -1).T * (LENGTH - 2e-9)
    for direction in np.eye(3):
        for end in ends:
            found = sums(library, np.array([end - CUTOFF / 4 * direction, end + CUTOFF / 4 * direction]), radius=CUTOFF)
            assert found == pytest.approx([value(CubicSpline, CUTOFF / 2)] * 2, rel=1e-9)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_position_that_is_not_finite_is_told(library, value):
    position = np.random.default_rng(1).uniform(0, LENGTH, (20, 3))
    position[7, 1] = value
    with pytest.raises(ValueError, match="particle 7 is not finite"):
        sums(library, position)


@pytest.mark.parametrize("count", [0, 1])
def test_without_pairs_sums_are_zero(library, count):
    assert np.array_equal(sums(library, np.full((count, 3), 0.2)), np.zeros(count))


def test_sums_without_a_gradient_say_so(library):
    space = PairSpace(LENGTH, True, 1.0, 1.0, 1.0, mutual=False)
    pairs = CompiledPairs(library, space, np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((0, 2)), np.ones(2, bool),
                          np.float64)
    with pytest.raises(ValueError, match="without a gradient"):
        pairs.gradients([kernel_sum(CubicSpline(1.0))], [np.zeros(0)], [np.zeros((1, 2))], True)


def test_kernels_end_where_they_should(library):
    for kernel in (CubicSpline, WendlandC2):
        for distance in (0.0, 0.1, 0.49, 0.51, 0.99):
            position = np.array([[1.0, 2, 3], [1.0, 2 + distance, 3]])
            space = PairSpace(LENGTH, True, 1.0, 1.0, 1.0, mutual=True)
            pairs = CompiledPairs(library, space, position, np.zeros_like(position), np.zeros((0, 2)),
                                  np.ones(2, bool), np.float64)
            found = pairs.sums([kernel_sum(kernel(1.0))], [np.zeros(0)])[0]
            assert found == pytest.approx(value(kernel, distance, 1.0))
