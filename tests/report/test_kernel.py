"""Numbers of the section on kernels."""

import itertools

import pytest

from eddies.report.kernel import section

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
