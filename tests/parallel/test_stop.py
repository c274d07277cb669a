"""All ranks agree that the job stops or a checkpoint is due, whichever of them has the reason."""

import signal

import pytest

from eddies.io.hdf5 import create_product
from eddies.parallel import stop as module
from eddies.parallel.stop import Stopped, StopRequest
from tests.commands import first_rank
from tests.parallel.counting import CountingComm


@pytest.fixture
def now(monkeypatch):
    """The wall time, which the test sets: {"seconds": 0}."""
    time = {"seconds": 0.0}
    monkeypatch.setattr(module.time, "monotonic", lambda: time["seconds"])
    return time


@pytest.mark.mpi(1, 3)
def test_a_signal_of_one_rank_stops_all(comm):
    received = []
    stop = StopRequest(comm, received)
    assert not stop() and not stop.checkpoint_due
    if comm.rank == comm.size - 1:
        received.append(signal.SIGTERM)
    assert stop() and stop.checkpoint_due and stop.reason == "SIGTERM"
    with pytest.raises(Stopped, match="SIGTERM"):
        stop.check()


@pytest.mark.mpi(2)
def test_the_stop_file_is_removed_when_obeyed(comm, tmp_path, now):
    stop = StopRequest(comm, stop_file=tmp_path / "STOP")
    assert not stop()
    first_rank(comm, (tmp_path / "STOP").write_text, "")
    assert not stop(), "looked again within the second"
    now["seconds"] = 1.5
    assert stop() and "STOP" in stop.reason
    comm.Barrier()
    assert not (tmp_path / "STOP").exists()
    assert stop(), "forgot it"


@pytest.mark.mpi(2, timeout=30)
def test_all_ranks_raise_if_the_stop_file_cannot_be_removed(comm, tmp_path, now):
    first_rank(comm, (tmp_path / "STOP").mkdir)
    with pytest.raises(OSError, match="STOP"):
        StopRequest(comm, stop_file=tmp_path / "STOP")()


@pytest.mark.mpi(2)
def test_checkpoints_are_due_at_intervals_until_the_wall_time_of_rank_0_ends(comm, now):
    stop = StopRequest(comm, max_seconds=23, checkpoint_seconds=10)
    due = []
    for seconds in (5, 11, 12, 20, 22):
        now["seconds"] = seconds if comm.rank == 0 else 99.0
        assert not stop()
        due.append(stop.checkpoint_due)
        if stop.checkpoint_due:
            stop.checkpoint_done()
    assert due == [False, True, False, False, True]
    now["seconds"] = 24.0 if comm.rank == 0 else 0.0
    assert stop() and "wall time" in stop.reason


@pytest.mark.mpi(1)
def test_one_rank_sends_nothing(comm):
    counting = CountingComm(comm)
    assert not StopRequest(counting)() and counting.sent == []


@pytest.mark.mpi(2)
def test_a_stop_leaves_nothing_of_a_product(comm, tmp_path):
    with pytest.raises(Stopped), create_product(comm, tmp_path / "model.h5", "model", {}):
        StopRequest(comm, [signal.SIGUSR1]).check()
    comm.Barrier()
    assert list(tmp_path.iterdir()) == []
