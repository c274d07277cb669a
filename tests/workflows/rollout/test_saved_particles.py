"""Rows of particles in checkpoints."""

import numpy as np
import pytest

from eddies.io.checkpoint import CheckpointDirectory
from eddies.parallel.slab import SlabDecomposition
from eddies.workflows.rollout.saved_particles import restored_rows, saved_rows


@pytest.mark.mpi(1, 2, 3)
def test_rows_come_back_as_they_stood(comm, tmp_path):
    """One particle a rank, two on the first and none on the last of three; in no order, and out of their slabs."""
    ids = {1: [[1, 0]], 2: [[2, 0], [1]], 3: [[1, 2], [0], []]}[comm.size][comm.rank]
    position = np.array([[0.1, 0.2, 0.3 * number] for number in ids]).reshape(-1, 3)
    columns = {"id": np.array(ids, np.int64), "position": position, "memory rate": np.array(ids, np.float32) / 3}
    checkpoints = CheckpointDirectory(comm, tmp_path / "checkpoints", "settings")
    checkpoints.write(1, saved_rows(comm, columns))
    found, same = restored_rows(SlabDecomposition(comm, 1.0, 6), checkpoints.newest())
    assert same and found.keys() == columns.keys()
    for name, column in columns.items():
        assert found[name].dtype == column.dtype and np.array_equal(found[name], column), name


@pytest.mark.mpi(3)
@pytest.mark.parametrize("before, after", [(3, 2), (2, 3)])
def test_on_another_number_of_ranks_they_are_in_their_slabs(comm, tmp_path, before, after):
    groups = {size: comm.Split(int(comm.rank < size)) for size in (before, after)}
    z = np.array([0.95, 0.05, 0.5, 0.4])
    if comm.rank < before:
        ids = np.flatnonzero(np.arange(4) % before == comm.rank)
        position = np.stack([np.zeros(len(ids)), np.zeros(len(ids)), z[ids]], axis=1)
        CheckpointDirectory(groups[before], tmp_path / "checkpoints", "settings").write(
            1, saved_rows(groups[before], {"id": ids, "position": position, "rate": 2.0 * ids}))
    comm.Barrier()
    if comm.rank < after:
        slab = SlabDecomposition(groups[after], 1.0, 6)
        found, same = restored_rows(slab, CheckpointDirectory(groups[after], tmp_path / "checkpoints",
                                                              "settings").newest())
        assert not same and np.array_equal(found["position"][:, 2], z[found["id"]])
        assert np.array_equal(found["rate"], 2.0 * found["id"])
        assert sorted(found["id"]) == np.flatnonzero((z >= slab.lower) & (z < slab.upper)).tolist()
    comm.Barrier()
