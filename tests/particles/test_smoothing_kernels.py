import pytest
import torch

from eddies.particles.smoothing_kernels import CubicSpline, HermiteKernel, KernelNetwork, WendlandC2, integral

SUPPORT = 0.7


def network(cutoff="smooth", **options):
    """A kernel network with weights far from the initial ones."""
    kernel = KernelNetwork(SUPPORT, cutoff=cutoff, seed=5, **options)
    with torch.no_grad():
        kernel.network.weights[-1].mul_(8)
    return kernel


KERNELS = {"spline": lambda: CubicSpline(SUPPORT), "wendland": lambda: WendlandC2(SUPPORT),
           "learned": lambda: network().table(), "learned, coarse table": lambda: network().table(9),
           "learned, sigmoid": lambda: network("sigmoid").table()}
kernels = pytest.mark.parametrize("kernel", [make() for make in KERNELS.values()], ids=list(KERNELS))


@kernels
def test_unit_integral(kernel):
    r = torch.linspace(0, SUPPORT, 40001, dtype=torch.float64)[:-1]
    by_hand = float(torch.trapezoid(4 * torch.pi * r**2 * kernel.value(r), r).detach())
    # The sigmoid ends with a jump, and the trapezoids miss the last interval.
    assert by_hand == pytest.approx(1, abs=1e-3 if kernel.value(r[-1]) > 0.01 else 1e-7)
    assert integral(kernel).item() == pytest.approx(1, abs=1e-13)


@kernels
def test_zero_at_and_beyond_the_support(kernel):
    r = torch.tensor([SUPPORT, SUPPORT * 1.5, 100.0], dtype=torch.float64)
    assert torch.all(kernel.value(r) == 0) and torch.all(kernel.derivative(r) == 0)


@kernels
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nowhere_negative(kernel, dtype):
    # Most points lie where smooth kernels vanish and rounding could change the sign.
    r = (SUPPORT * (1 - torch.logspace(0, -12, 40001, dtype=torch.float64))).to(dtype)
    assert torch.all(kernel.value(r) >= 0) and kernel.value(SUPPORT * torch.tensor(0.99, dtype=dtype)) > 0


def test_steep_slopes_make_no_table_negative():
    values, slopes = torch.tensor([[5.0, 0.01, 2.0, 0.0], [-20.0, -5.0, 40.0, -1.0]], dtype=torch.float64)
    table = HermiteKernel(SUPPORT, values, slopes)
    assert torch.all(table.value(torch.linspace(0, SUPPORT, 3001, dtype=torch.float64)[:-1]) > 0)
    knots = SUPPORT / 3 * torch.arange(3, dtype=torch.float64)
    assert torch.allclose(table.value(knots) * SUPPORT**3, values[:3], rtol=1e-12)


@kernels
def test_derivative_is_that_of_the_value_and_zero_at_the_centre(kernel):
    """Kernels that are zero at the support have no slope there either."""
    r = torch.linspace(0, 1.2 * SUPPORT, 500, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(kernel.value(r).sum(), r)
    assert torch.allclose(kernel.derivative(r), slope, atol=1e-11)
    ends = torch.tensor([0.0, SUPPORT * (1 - 1e-9)], dtype=torch.float64)
    slopes = (kernel.derivative(ends) * SUPPORT**4).abs()
    assert slopes[0] < 1e-2  # a sigmoid has a small slope at the centre
    assert slopes[1] < 1e-6 or kernel.value(ends[1]) > 1e-6


def test_a_table_agrees_with_its_network():
    kernel = network()
    q = torch.linspace(0, 1, 1001, dtype=torch.float64)
    exact = torch.exp(kernel.network((2 * q * q - 1)[None])[0]) * (1 - q * q) ** 2 / kernel.integral()
    assert torch.allclose(kernel.table().value(q * SUPPORT) * SUPPORT**3, exact, atol=1e-6)


def test_a_table_is_differentiable_in_values_slopes_and_weights():
    values, slopes = torch.rand(2, 6, dtype=torch.float64, requires_grad=True).unbind()
    r = SUPPORT * torch.rand(20, dtype=torch.float64)

    def both(values, slopes):
        kernel = HermiteKernel(SUPPORT, values, slopes)
        return torch.stack([kernel.value(r), kernel.derivative(r)])

    assert torch.autograd.gradcheck(both, (values, slopes))
    kernel = network()
    table = kernel.table(17)
    (table.value(r) ** 2 + table.derivative(r) ** 2).sum().backward()
    assert all(bool((weight.grad != 0).any()) for weight in kernel.network.weights)


def test_the_published_form_may_be_negative_and_is_not_normalised():
    """W h^3 = NN(q) / (1 + exp(10 (q - 1))), Eq. 7."""
    kernel = KernelNetwork(SUPPORT, cutoff="sigmoid", seed=5, mean_volume=0.1)
    q = torch.linspace(0, 0.999, 1001, dtype=torch.float64)
    exact = kernel.network(q[None])[0] / (1 + torch.exp(10 * (q - 1)))
    with torch.no_grad():
        table = kernel.table()
    assert table.mean_volume == 0.1 and exact.min() < 0
    assert torch.allclose(table.value(q * SUPPORT) * SUPPORT**3, exact, atol=1e-6)
    assert integral(table).item() == pytest.approx(kernel.integral().item()) != pytest.approx(1, abs=0.1)
