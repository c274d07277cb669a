import pytest

from eddies.kernels import library as module


@pytest.fixture(params=module.INSTRUCTION_SETS)
def library(request, monkeypatch):
    """The library that all kernels use, for each instruction set that this processor runs."""
    if request.param not in module.instruction_sets():
        pytest.skip("this processor does not run it")
    monkeypatch.setattr(module, "in_use", lambda: request.param)
    module.library.cache_clear()
    yield module.library()
    module.library.cache_clear()


@pytest.fixture
def close():
    """A function that compares arrays, within an error relative to the largest expected value."""
    def compare(found, expected, relative, least=0.0):
        assert found.shape == expected.shape
        assert abs(found - expected).max(initial=0) <= relative * max(abs(expected).max(initial=0), least)

    return compare
