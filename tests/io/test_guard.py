"""What looks on before each step."""

from types import SimpleNamespace

import pytest

from eddies.io.guard import Guard
from eddies.parallel.stop import Stopped, StopRequest


@pytest.mark.mpi(1, 2)
def test_checkpoints_are_written_when_due_and_before_a_stop(comm, tmp_path):
    stop = StopRequest(comm, checkpoint_seconds=1e9)
    guard = Guard(comm, tmp_path / "checkpoints", "settings", stop, " of the test")
    run = SimpleNamespace(steps=3, state_dict=lambda: {"steps": run.steps})
    guard(run)
    assert guard.checkpoints.newest() is None
    stop._checkpoint_at = 0.0
    guard(run)
    assert guard.checkpoints.newest()["steps"] == 3
    run.steps = 4
    guard(run)  # none is due so soon
    assert guard.checkpoints.newest()["steps"] == 3
    stop.signals = [10]
    with pytest.raises(Stopped, match="SIGUSR1; the same command goes on from step 4 of the test"):
        guard(run)
    assert guard.checkpoints.newest()["steps"] == 4
