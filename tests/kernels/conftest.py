import pytest

from eddies.kernels.library import INSTRUCTION_SETS, instruction_sets, load


@pytest.fixture(params=INSTRUCTION_SETS)
def library(request):
    """The library for each instruction set that this processor runs."""
    if request.param not in instruction_sets():
        pytest.skip("this processor does not run it")
    return load(request.param)
