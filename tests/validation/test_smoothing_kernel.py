"""The program that asks how well averages over neighbours can do, on known fields and on a small flow."""

import numpy as np
import pytest
import torch
from flows import WITH_TRACERS
from smoothing_kernel import AIMS, Field, fitted

from eddies.scene.scene import load_scene
from eddies.workflows import dns


@pytest.mark.parametrize("degree", [1, 2])
def test_moving_least_squares_reproduce_polynomials(degree):
    random = np.random.default_rng(1)
    position = torch.from_numpy(random.uniform(0, 2 * np.pi, (2000, 3)))
    points = torch.from_numpy(random.uniform(2, 4, (50, 3)))  # the box ends beyond the support
    slopes, curvature = torch.from_numpy(random.standard_normal((3, 3))), degree - 1

    def field(x):
        return x @ slopes.T + curvature * (x * x.roll(1, 1))

    velocity, gradient = fitted(points, position, field(position), 1.2, degree)
    expected = slopes.repeat(50, 1, 1)
    for component in range(3):  # of x_i x_(i-1)
        expected[:, component, component] += curvature * points.roll(1, 1)[:, component]
        expected[:, component, component - 1] += curvature * points[:, component]
    # The ridge of 1e-8 is what is left.
    torch.testing.assert_close(velocity, field(points), rtol=0, atol=1e-5)
    torch.testing.assert_close(gradient, expected, rtol=0, atol=1e-4)


@pytest.mark.mpi(1)
def test_the_best_kernel_is_better_than_the_one_that_it_starts_from(comm, tmp_path):
    (tmp_path / "scene.toml").write_text(WITH_TRACERS)
    dns.run(load_scene(tmp_path / "scene.toml"), comm, tmp_path)
    errors = Field(tmp_path, 40.0).errors(steps=8)
    for name, aim in AIMS.items():
        losses = [float(np.dot(aim, np.square(errors[of]))) for of in (f"best for {name}", "cubic spline")]
        assert losses[0] < losses[1]
    # An average flattens what curves; a polynomial of second order follows it.
    assert errors["moving least squares, quadratic"][0] < 0.5 * errors["best for velocity"][0]
