"""The library is found and built for, or said to be missing."""

import logging

import pytest

from eddies.kernels import library as module


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """No library where it is looked for."""
    monkeypatch.setattr(module, "__file__", str(tmp_path / "library.py"))
    module.library.cache_clear()
    yield tmp_path
    module.library.cache_clear()


def test_without_a_library_one_line_says_so(elsewhere, caplog):
    with caplog.at_level(logging.INFO, "eddies"):
        assert [module.library() for _ in range(3)] == [None] * 3
    assert [record.message for record in caplog.records] == [module.MISSING]


def test_without_the_plain_one_none_is_trusted_to_run(elsewhere):
    (elsewhere / "avx2.so").write_bytes(b"")
    assert module.instruction_sets() == []


def test_the_best_that_the_processor_runs_is_taken():
    found = module.instruction_sets()
    if not found:
        pytest.skip("the library is not compiled")
    assert found[0] == "plain" and module.library() is module.load(found[-1])
