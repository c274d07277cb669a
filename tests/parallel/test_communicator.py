"""Ranks of a node, and the processors for their threads."""

import logging

import pytest

from eddies.parallel import communicator


@pytest.mark.mpi(3)
def test_all_ranks_here_share_a_node(comm):
    assert communicator.node_rank(comm) == comm.rank and communicator.node_ranks(comm) == 3


@pytest.mark.mpi(2)
@pytest.mark.parametrize("number, there, own", [
    ("1", lambda rank: {0}, None), ("2", lambda rank: {0}, 1), ("2", lambda rank: {2 * rank, 2 * rank + 1}, None),
    ("4", lambda rank: set(range(4)), 2)], ids=["one", "one core for all", "bound", "not bound"])
def test_ranks_without_processors_for_their_threads_get_a_warning(comm, monkeypatch, caplog, number, there, own):
    monkeypatch.setenv("OMP_NUM_THREADS", number)
    monkeypatch.setattr(communicator, "processors", lambda: there(comm.rank))
    monkeypatch.setattr(communicator, "within_quota", len)
    with caplog.at_level(logging.WARNING, "eddies"):
        communicator.warn_of_few_processors(comm)
    lines = [record.getMessage() for record in caplog.records]
    if comm.rank > 0 or own is None:
        assert lines == []
    else:
        assert len(lines) == 1 and f"{number} exceeds the number of processors of a rank, {own}, " in lines[0]
