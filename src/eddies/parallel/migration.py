"""Migration: particles move to the rank whose slab contains them, or to the rank that stores their id."""

import math

import numpy as np
from mpi4py import MPI

from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition, block_starts


class ParticleLossError(RuntimeError):
    """Particles were lost or duplicated in a migration."""


class Redistribution:
    """Sends each row of a column to a given rank. One object serves all columns of the same particles.

    `destination` (n,) is the rank that each row goes to. Received rows are sorted by the rank that sent them, and rows
    from one rank keep their order, until `arrange` is called. With a single rank no message is sent.
    """

    def __init__(self, comm: MPI.Comm, destination: np.ndarray) -> None:
        self.comm = comm
        self._arrangement: np.ndarray | None = None
        if comm.size == 1:
            return
        self._order = np.argsort(destination, kind="stable")
        self._sent = np.bincount(destination, minlength=comm.size)
        self._received = np.empty_like(self._sent)
        comm.Alltoall(self._sent, self._received)

    def arrange(self, order: np.ndarray) -> None:
        """Let `apply` return the received rows in this `order` (m,) from now on."""
        self._arrangement = order

    def apply(self, column: np.ndarray) -> np.ndarray:
        """Return the rows (m, ...) of a column (n, ...) that belong to this rank after the exchange."""
        received = np.asarray(column)
        if self.comm.size > 1:
            received = self._exchange(np.take(received, self._order, axis=0), self._sent, self._received)
        return received.copy() if self._arrangement is None else np.take(received, self._arrangement, axis=0)

    def adjoint(self, rows: np.ndarray) -> np.ndarray:
        """Send the rows (m, ...) of a column that `apply` has returned back to their former ranks. Return the column
        (n, ...)."""
        rows = np.asarray(rows)
        if self._arrangement is not None:
            rows = _put(rows, self._arrangement)
        return rows.copy() if self.comm.size == 1 else _put(self._exchange(rows, self._received, self._sent),
                                                            self._order)

    def _exchange(self, rows: np.ndarray, sent: np.ndarray, received: np.ndarray) -> np.ndarray:
        """Send the numbers `sent` of rows to the ranks, in their order, and return the `received` numbers of rows."""
        result = np.empty((int(received.sum()), *rows.shape[1:]), rows.dtype)
        # Counts are in rows: in bytes they would exceed the range of MPI's integers above 2 GiB.
        row = MPI.BYTE.Create_contiguous(rows.dtype.itemsize * math.prod(rows.shape[1:])).Commit()
        self.comm.Alltoallv([np.ascontiguousarray(rows), sent, row], [result, received, row])
        row.Free()
        return result


def _put(rows: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return the rows, each at its place."""
    result = np.empty_like(rows)
    result[places] = rows
    return result


def wrap(positions: np.ndarray, length: float) -> np.ndarray:
    """Return positions shifted by whole periods into [0, length)."""
    wrapped = np.mod(positions, length)
    # The remainder of a tiny negative number rounds to `length` itself.
    wrapped[wrapped >= length] = 0.0
    return wrapped


def census(comm: MPI.Comm, ids: np.ndarray) -> tuple[int, int, int]:
    """Return the number of particles on all ranks, the sum of their ids, and the exclusive-or of their ids."""
    count, total = global_sum(comm, np.array([len(ids), ids.sum()], np.int64))
    parity = np.array(np.bitwise_xor.reduce(ids) if len(ids) else 0, np.int64)
    if comm.size > 1:
        comm.Allreduce(MPI.IN_PLACE, parity, op=MPI.BXOR)
    return int(count), int(total), int(parity)


class Migration(Redistribution):
    """Moves particles to the slabs that contain them. `ids` are those of the received rows.

    `ids` (n,) and `positions` (n, 3), inside the box, belong to this rank's particles. Raises ParticleLossError if the
    number of particles, the sum of the ids or their exclusive-or changes.
    """

    def __init__(self, decomposition: SlabDecomposition, ids: np.ndarray, positions: np.ndarray) -> None:
        super().__init__(decomposition.comm, decomposition.owner_of(positions[:, 2]))
        self.ids = self.apply(ids)
        if decomposition.size == 1:
            return
        before, after = (census(decomposition.comm, each) for each in (ids, self.ids))
        if before != after:
            raise ParticleLossError(f"migration changed (count, sum of ids, exclusive-or of ids) from {before} to "
                                    f"{after}")


def migrate(decomposition: SlabDecomposition, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return all columns of a particle set after each particle has moved to the slab that contains it.

    `columns` holds at least `id` (n,) and `position` (n, 3); positions are wrapped into the box first. Raises
    ParticleLossError if particles are lost.
    """
    columns = {**columns, "position": wrap(columns["position"], decomposition.length)}
    migration = Migration(decomposition, columns["id"], columns["position"])
    return {name: migration.apply(column) for name, column in columns.items()}


def id_block(comm: MPI.Comm, total: int) -> tuple[int, int]:
    """Return the first id and the (exclusive) end of the block of ids that this rank stores, out of `total` ids."""
    starts = block_starts(total, comm.size)
    return int(starts[comm.rank]), int(starts[comm.rank + 1])


class IdOrder(Redistribution):
    """Moves particles from any distribution into blocks of consecutive ids, one block per rank.

    `ids` (n,) are this rank's ids. Over all ranks, each id 0 ... total - 1 occurs once. `start` and `stop` bound the
    block that `apply` returns. Raises ParticleLossError if an id of the block is missing or occurs twice.
    """

    def __init__(self, comm: MPI.Comm, ids: np.ndarray, total: int) -> None:
        self.start, self.stop = id_block(comm, total)
        super().__init__(comm, np.searchsorted(block_starts(total, comm.size), ids, side="right") - 1)
        self.arrange(np.argsort(self.apply(ids)))
        if not np.array_equal(self.apply(ids), np.arange(self.start, self.stop)):
            raise ParticleLossError(f"ids {self.start} to {self.stop - 1} are not each present exactly once")
