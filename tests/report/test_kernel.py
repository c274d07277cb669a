"""Numbers of the section on kernels."""

import itertools

import numpy as np
import pytest

from eddies.report.kernel import section, shapes

# The start of the keys of each kernel.
KERNELS = {"learned": "", "learned_no_gradient": "no_gradient_", "cubic_spline": "cubic_spline_",
           "wendland": "wendland_"}


@pytest.mark.usefixtures("no_figures")
def test_each_kernel_has_its_own_errors():
    pairs = list(itertools.product(("velocity", "gradient"), KERNELS))
    errors = {f"{what}_error_{kernel}": number / 10 for number, (what, kernel) in enumerate(pairs)}
    found = section(1.0, {}, {}, {**errors, "integral_learned": 1.0}).numbers
    for what, kernel in pairs:
        assert found[f"{KERNELS[kernel]}{what}_error"] == errors[f"{what}_error_{kernel}"]


def test_an_inset_shows_the_peak_of_the_kernel_without_the_gradient_loss():
    """A peak of 1.1 times the centre at r/h = 0.4, which the scale of the other kernel hides."""
    radius = np.linspace(0, 1, 101)
    flat = 0.3 * (1.1 - 0.1 * (1 - radius / 0.4) ** 2)
    kernels = {"r_over_h": radius, "value_learned": 3 - 3 * radius, "value_learned_no_gradient": flat}
    (inset,) = shapes(kernels).axes[0].child_axes
    line = inset.lines[0].get_xydata()
    assert line[line[:, 1].argmax()] == pytest.approx([0.4, 1.1])
    assert not shapes({"r_over_h": radius, "value_learned": 3 - 3 * radius}).axes[0].child_axes
