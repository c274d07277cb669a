import pytest

from eddies.kernels.library import INSTRUCTION_SETS, instruction_sets, load


@pytest.fixture(params=INSTRUCTION_SETS)
def library(request):
    """The library for each instruction set that this processor runs."""
    if request.param not in instruction_sets():
        pytest.skip("this processor does not run it")
    return load(request.param)


@pytest.fixture
def close():
    """A function that compares arrays, within an error relative to the largest expected value."""
    def compare(found, expected, relative):
        assert found.shape == expected.shape
        largest = max(abs(expected).max(), 1e-300) if expected.size else 0.0
        assert expected.size == 0 or abs(found - expected).max() <= relative * largest

    return compare
