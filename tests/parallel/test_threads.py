"""Threads of ranks that have too few processors."""

import logging

import pytest

from eddies.parallel import threads


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("number, there, own", [
    ("1", lambda rank: {0}, None), ("2", lambda rank: {0}, 1), ("2", lambda rank: {2 * rank, 2 * rank + 1}, None),
    ("4", lambda rank: set(range(4)), {1: None, 2: 2})], ids=["one", "one core for all", "bound", "not bound"])
def test_ranks_without_processors_for_their_threads_are_told(comm, monkeypatch, caplog, number, there, own):
    monkeypatch.setenv("OMP_NUM_THREADS", number)
    monkeypatch.setattr(threads, "processors", lambda: there(comm.rank))
    monkeypatch.setattr(threads, "within_quota", len)
    own = own[comm.size] if isinstance(own, dict) else own
    with caplog.at_level(logging.WARNING, "eddies"):
        threads.warn_of_few_processors(comm)
    told = [record.getMessage() for record in caplog.records]
    if comm.rank > 0 or own is None:
        assert told == []
    else:
        line, = told
        assert line.startswith(f"OMP_NUM_THREADS = {number}: each rank has {own} of the processors here")
