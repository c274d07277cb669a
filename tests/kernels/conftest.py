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
    def compare(found, expected, relative, least=0.0):
        assert found.shape == expected.shape
        assert abs(found - expected).max(initial=0) <= relative * max(abs(expected).max(initial=0), least)

    return compare
