import numpy as np
import pytest

from eddies.analysis.velocity_gradients import (
    ConditionalVelocity, InvariantBins, Invariants, enstrophy_scale, invariants, vieillefosse_line, vorticity,
)


def random_gradients(count, seed=6):
    return np.random.default_rng(seed).normal(size=(count, 3, 3))


def test_simple_flows():
    spin, strain = np.zeros((3, 3)), np.diag([1.0, 1.0, -2.0])
    spin[0, 1], spin[1, 0] = -1.5, 1.5
    assert invariants(spin) == pytest.approx((1.5**2, 0))
    second, third = invariants(strain)
    assert (second, third) == pytest.approx((-3, 2)) and vieillefosse_line(third) == pytest.approx(second)
    assert enstrophy_scale(spin[None]) == pytest.approx(1.5**2)
    assert enstrophy_scale(strain[None]) == 0


def test_invariants_ignore_dilatation_and_rotation():
    gradient = random_gradients(20)
    rotation, _ = np.linalg.qr(np.random.default_rng(8).normal(size=(3, 3)))
    expected = np.array(invariants(gradient))
    assert np.allclose(invariants(gradient + 3 * np.eye(3)), expected)
    assert np.allclose(invariants(rotation @ gradient @ rotation.T), expected)


def test_bins_keep_all_particles():
    second, third = invariants(random_gradients(5000))
    bins = InvariantBins.covering(second, third, quantile=0.9)
    cells = bins.probabilities(second, third)
    inside = (abs(second) < bins.second[-1]) & (abs(third) < bins.third[-1])
    assert cells.sum() == pytest.approx(1) and cells[1:-1, 1:-1].sum() < inside.mean() < 0.9
    assert cells.sum(axis=1)[0] == pytest.approx(np.mean(second < bins.second[1]))
    area = np.outer(np.diff(bins.second), np.diff(bins.third))
    assert np.sum(bins.density(cells) * area) == pytest.approx(1)


def restricted_euler(gradient):
    squared = gradient @ gradient
    return -squared + np.trace(squared, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)


def exactly(gradient):
    """In double precision, for differences over short times."""
    return Invariants(*invariants(gradient), enstrophy_scale(gradient))


def midpoint_step(gradient, step):
    return gradient + step * restricted_euler(gradient + step / 2 * restricted_euler(gradient))


def test_conditional_velocity_of_restricted_euler():
    """dA/dt = -A^2 + Tr(A^2)/3 I gives exactly dQ/dt = -3 R and dR/dt = 2/3 Q^2."""
    gradient = random_gradients(60_000)
    gradient -= np.trace(gradient, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    scale, step = enstrophy_scale(gradient), 1e-3
    second, third = invariants(gradient)
    bins = InvariantBins.covering(second / scale, third / scale**1.5, quantile=0.9)
    flow = ConditionalVelocity(bins)
    for _ in range(2):
        after = midpoint_step(gradient, step)
        flow.add(exactly(gradient), exactly(after), step, scale)
        gradient = after
    second_rate, third_rate = flow.mean(at_least=30)
    q = ((bins.second[1:] + bins.second[:-1]) / 2)[:, None]
    r = ((bins.third[1:] + bins.third[:-1]) / 2)[None, :]
    known = np.isfinite(second_rate)
    assert known.sum() > 100
    exact = np.broadcast_to(-3 * r, known.shape)[known], np.broadcast_to(2 / 3 * q**2, known.shape)[known]
    bin_width = np.diff(bins.third)[0], np.diff(bins.second)[0]
    assert np.abs(second_rate[known] - exact[0]).max() < 3 * bin_width[0] / 2 * 1.01
    assert np.abs(third_rate[known] - exact[1]).max() < 2 / 3 * bin_width[1] * np.abs(q).max() * 1.1


def test_cells_with_few_particles_are_nan():
    flow = ConditionalVelocity(InvariantBins(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5)))
    still = Invariants.of(np.zeros((3, 3, 3)))
    flow.add(still, still, 0.1, 1.0)
    assert np.isfinite(flow.mean(at_least=3)[0]).sum() == 1
    assert np.isfinite(flow.mean(at_least=4)[0]).sum() == 0


@pytest.mark.parametrize("cells", [9, 12])
def test_vorticity_of_an_abc_flow_is_its_velocity(cells):
    z, y, x = 2 * np.pi / cells * np.indices((cells,) * 3)
    a, b, c = 1.0, 0.8, 0.6
    flow = np.stack([a * np.sin(z) + c * np.cos(y), b * np.sin(x) + a * np.cos(z), c * np.sin(y) + b * np.cos(x)])
    assert np.allclose(vorticity(flow), flow, atol=1e-13)
