import numpy as np

from eddies.flow.filtering import gaussian_transfer


def test_the_filter_has_the_second_moment_of_a_box_of_its_width():
    """A box of width d passes sin(x) / x with x = k d / 2. The Gaussian differs by (1/1152 - 1/1920) (k d)^4 and less
    in higher powers; one of another second moment differs in (k d)^2."""
    width, k = 0.7, np.array([0.05, 0.1, 0.2, 0.4])
    box = np.sinc(k * width / (2 * np.pi))
    assert np.all(np.abs(gaussian_transfer(k**2, width) - box) < 4e-4 * (k * width) ** 4)
