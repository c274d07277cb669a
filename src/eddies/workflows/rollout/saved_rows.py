"""Rows of particles in a checkpoint: as they stand on the ranks, so that sums over them are the same bit for bit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from eddies.io.checkpoint import Block, Checkpoint
from eddies.parallel.communicator import Comm
from eddies.parallel.migration import migrate
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition, block_starts


def saved_rows(comm: Comm, columns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Columns (n, ...), among them `id` and `position`, for a checkpoint: the rows of each rank follow those of the
    rank before it; collective."""
    rows = np.zeros(comm.size, np.int64)
    rows[comm.rank] = len(columns["id"])
    rows = global_sum(comm, rows)
    first, total = int(rows[:comm.rank].sum()), int(rows.sum())
    return {"columns": list(columns), "rows_of_ranks": rows,
            **{f"particles {name}": Block(column, first, total) for name, column in columns.items()}}


def restored_rows(slab: SlabDecomposition, saved: Checkpoint) -> tuple[dict[str, np.ndarray], bool]:
    """The columns of this rank, and whether they are the very rows that it saved; on another number of ranks they are
    those of the particles in its slab. Collective."""
    rows = saved["rows_of_ranks"]
    same = len(rows) == slab.size
    starts = np.concatenate([[0], np.cumsum(rows)]) if same else block_starts(int(rows.sum()), slab.size)
    block = int(starts[slab.rank]), int(starts[slab.rank + 1])
    columns = {name: saved.read(f"particles {name}", *block) for name in saved["columns"]}
    return (columns if same else migrate(slab, columns)), same
