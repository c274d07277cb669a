import math

import pytest
import torch

from eddies.particles.periodic_box import PeriodicBox, safe_norm


@pytest.mark.parametrize("periodic_z", [True, False])
def test_displacement_is_the_shortest_along_periodic_axes(periodic_z):
    box = PeriodicBox(5.0, periodic_z)
    a, b = torch.tensor([[0.1, 4.9, 4.9]]), torch.tensor([[4.9, 0.1, 0.1]])
    assert torch.allclose(box.displacement(a, b), torch.tensor([[0.2, -0.2, -0.2 if periodic_z else 4.8]]))


def test_wrapped_positions_lie_in_the_half_open_box():
    wrapped = PeriodicBox(2 * math.pi).wrap(torch.tensor([[-1e-20, 2 * math.pi, 7.0]], dtype=torch.float64))
    assert torch.all((wrapped >= 0) & (wrapped < 2 * math.pi)) and wrapped[0, 2] == 7.0 - 2 * math.pi
    assert PeriodicBox(1.0, periodic_z=False).wrap(torch.full((1, 3), 1.5)).tolist() == [[0.5, 0.5, 1.5]]


def test_norm_has_zero_gradient_at_zero():
    vectors = torch.tensor([[0.0, 3.0], [0.0, 0.0], [0.0, 4.0]], requires_grad=True)
    length = safe_norm(vectors)
    length.sum().backward()
    assert length.tolist() == [0.0, 5.0]
    assert torch.allclose(vectors.grad, torch.tensor([[0.0, 0.6], [0.0, 0.0], [0.0, 0.8]]))
