"""Work of some ranks: all ranks get its result or raise its error."""

import pytest

from eddies.errors import UserError
from eddies.parallel import broadcast
from eddies.parallel.broadcast import all_arrive, first_complaint, on_all_ranks, on_first_rank, require_same
from eddies.scene.values import KeyProblem, SceneError

pytestmark = pytest.mark.mpi(1, 3)


def test_all_ranks_get_what_the_first_one_finds(comm):
    asked = []
    assert on_first_rank(comm, lambda: asked.append(comm.rank) or {"rank": comm.rank}) == {"rank": 0}
    assert asked == ([0] if comm.rank == 0 else [])


def raising(error):
    raise error


@pytest.mark.parametrize("error", [UserError("no"), SceneError("no", "flow.cells"), KeyProblem("flow", "cells", ": no"),
                                   FileNotFoundError(2, "No such file", "there"), OSError("odd")], ids=repr)
def test_an_error_of_the_first_rank_is_raised_by_all(comm, error):
    with pytest.raises(type(error)) as raised:
        on_first_rank(comm, lambda: raising(error))
    assert str(raised.value) == str(error)
    for name in ("errno", "strerror", "filename", "key", "section"):
        assert getattr(raised.value, name, None) == getattr(error, name, None)


def test_an_error_of_any_rank_is_raised_by_all(comm):
    last = comm.size - 1
    with pytest.raises(OSError, match="^disk full$"):
        on_all_ranks(comm, lambda: raising(OSError(28, "disk full", "there")) if comm.rank == last else None)
    assert on_all_ranks(comm, lambda: comm.rank) == comm.rank


def test_the_complaint_of_the_lowest_rank_counts(comm):
    assert first_complaint(comm, f"rank {comm.rank}" if comm.rank >= comm.size // 2 else None) == (
        f"rank {comm.size // 2}")
    assert first_complaint(comm, None) is None


def test_ranks_that_were_started_differently_are_refused(comm):
    require_same(comm, "tiny", "scene {}")
    if comm.size > 1:
        with pytest.raises(UserError, match="rank 2 was started with scene other, rank 0 with scene tiny"):
            require_same(comm, "other" if comm.rank == 2 else "tiny", "scene {}")


def test_a_rank_does_not_wait_for_ever_for_the_others(comm, monkeypatch):
    own, last = comm.Dup(), comm.rank == comm.size - 1
    assert all_arrive(own)
    monkeypatch.setattr(broadcast, "PATIENCE", 0.1)
    if not last:
        assert not all_arrive(own)
    comm.Barrier()
    if last:
        own.Ibarrier().Wait()  # so that no message stays under way
    comm.Barrier()
