"""A product while it is written: its HDF5 file under a temporary name, and the room on the disk that it has."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
from mpi4py import MPI

from eddies.io.errors import NoRoom, ProductError, WriteError, wanted_and_free, write_error
from eddies.io.run_lock import RunTakenOver
from eddies.io.single_writer import gather_frame, has_single_writer
from eddies.io.sink import MARGIN_BYTES, Sink, check_limit, reserve
from eddies.io.verification import add_checksums
from eddies.parallel.broadcast import first_complaint, on_first_rank

# Of the index of a chunked dataset, for each chunk, and of a dataset beside its values: more than HDF5 takes.
INDEX_BYTES, HEADER_BYTES = 2**8, 2**14

# What is being written, by the name that HDF5 has for the file.
_open: dict[str, Unfinished] = {}
# Files whose writing was broken off by an exception. Closing one is collective, so it must not happen when
# Python drops the last reference on one rank alone; they stay open until the process ends.
_abandoned: list[Unfinished] = []


class Unfinished:
    """An HDF5 file that is written by all ranks together. All methods are collective.

    HDF5 does not survive a write that fails: it crashes when it closes the file or, with several ranks, those that
    could write wait for the one that could not. So every write is announced, and blocks of the disk are taken for it
    beforehand; a margin stays taken for what HDF5 writes when it closes the file, and is cut off then. Where blocks
    cannot be taken and the disk fills meanwhile, one rank still writes into a `Sink`; of several that write together
    the one that meets it raises ProductError, upon which the job has to be aborted.

    Where rank 0 writes for all, the others have a file in memory with the same groups, attributes and shapes, so that
    nobody else needs to know of it; of frames it holds nothing.
    """

    def __init__(self, comm: MPI.Comm, path: Path) -> None:
        self.comm, self.path, self.broken = comm, path, False
        self._needed, self._held = 0, 0
        self._sink: Sink | None = None
        self._together = comm.size > 1 and not has_single_writer(comm)
        if self._together:
            self._alike(self._make)
            self._alike(self._open_together)
        else:
            self._alike(self._open_sink if comm.rank == 0 else self._open_in_memory)
        self._inode = path.stat().st_ino if comm.rank == 0 else 0
        self._name = self.file.filename
        _open[self._name] = self

    def take(self, size: int) -> None:
        """Take room for so many bytes more than were asked for before; the same on all ranks.

        WriteError on all ranks where there is none: the file can still be closed."""
        self._needed += size
        if self._needed + MARGIN_BYTES > self._held:
            stop = self._needed + 2 * MARGIN_BYTES
            self._alike(lambda: self._reserve(stop))
            self._held = stop

    def check(self) -> None:
        """Raise WriteError where rank 0, which writes alone, could not do so in spite of the room taken."""
        if not self._together:
            self._alike(lambda: self._sink and self._sink.check())

    def written_here(self, shape: tuple[int, ...], block: np.ndarray,
                     offset: tuple[int, ...]) -> tuple[np.ndarray, tuple[int, ...]]:
        """What this rank writes of a frame of this shape, of which it has a block, and where. A single value all ranks
        have and write."""
        if self.comm.size == 1 or self._together or not shape:
            return block, offset
        return gather_frame(self.comm, shape, block, offset)

    def close(self) -> None:
        """Close the file, cutting off the room that it does not need."""
        _open.pop(self._name, None)
        self.file.close()
        if self._sink is not None:
            self._sink.close()

    def add_checksums(self) -> None:
        """Add checksums to the closed file, unless it is that of another job. WriteError on all ranks."""
        if on_first_rank(self.comm, self._is_own):
            self._alike(lambda: add_checksums(self.comm, self.path))

    def remove(self) -> None:
        """Remove the closed file, unless it is that of another job. Rank 0 alone calls it."""
        if self._is_own():
            self.path.unlink()

    def publish(self, path: Path) -> None:
        """Give the closed file its name; RunTakenOver where its former one is another job's, which has taken the
        directory over. Rank 0 alone calls it."""
        if not self._is_own():
            raise RunTakenOver(f"{path}: another job has taken this run directory over; this one ends and leaves all "
                               "as it is")
        os.replace(self.path, path)

    def _is_own(self) -> bool:
        return self.path.exists() and self.path.stat().st_ino == self._inode

    def abandon(self) -> None:
        """Leave the file where it is, as other ranks may not know that it is not written any more; and open, if
        closing it needs them all."""
        if self._together:
            _open.pop(self._name, None)
            _abandoned.append(self)
        else:
            self.close()

    def _open_sink(self) -> None:
        self._sink = Sink(self.path)
        self.file = h5py.File(self._sink, "w")

    def _open_in_memory(self) -> None:
        self.file = h5py.File(self.path, "w", driver="core", backing_store=False)

    def _make(self) -> None:
        """Make a file without content, as HDF5 would empty one that it makes anew, and give back its room."""
        if self.comm.rank == 0:
            empty = io.BytesIO()
            h5py.File(empty, "w").close()
            try:
                self.path.write_bytes(empty.getvalue())
            except OSError:
                self.path.unlink(missing_ok=True)
                raise

    def _open_together(self) -> None:
        self.file = h5py.File(self.path, "r+", driver="mpio", comm=self.comm)

    def _reserve(self, stop: int) -> None:
        try:
            check_limit(stop)
            if self.comm.rank == 0:
                descriptor = os.open(self.path, os.O_RDWR)
                try:
                    reserve(descriptor, self._held, stop)
                finally:
                    os.close(descriptor)
        except OSError as error:
            raise NoRoom.of(error, self.path, stop - self._held) from None

    def _error(self, error: OSError) -> WriteError:
        words = f"{self.path}: cannot be written: {error.strerror or error}; check its directory"
        return write_error(self.path, error, words)

    def _alike(self, work: Callable[[], object]) -> None:
        """Do what may fail on a rank: all ranks raise the WriteError of the lowest."""
        complaint = None
        try:
            work()
        except OSError as error:
            complaint = str(self._error(error))
        complaint = first_complaint(self.comm, complaint)
        if complaint is not None:
            raise WriteError(complaint)


def writing_failed() -> bool:
    """Whether HDF5 could not write a file that it shares with other ranks: it would crash at the end of the process."""
    return any(unfinished.broken for unfinished in _abandoned)


@contextmanager
def writing(group: h5py.Group | h5py.Dataset, size: int) -> Iterator[None]:
    """Write so many bytes to a file inside the block, after having taken room for them; all ranks do.

    Raises:
        WriteError: on all ranks; there is no room.
        ProductError: on this rank; HDF5 could not write in spite of that.
    """
    unfinished = _open[group.file.filename]
    unfinished.take(size)
    try:
        yield
    except (OSError, RuntimeError) as error:
        unfinished.check()
        unfinished.broken = True
        lack = wanted_and_free(unfinished.path, size)
        raise ProductError(f"{unfinished.path}: cannot be written: {error}: {lack}; make room, or check the disk, then "
                           "run the command again") from None
    unfinished.check()


def written_here(dataset: h5py.Dataset, block: np.ndarray,
                 offset: tuple[int, ...]) -> tuple[np.ndarray, tuple[int, ...]]:
    """What this rank writes of the next frame of a dataset, of which it has a block at an offset; collective."""
    return _open[dataset.file.filename].written_here(dataset.shape[1:], block, offset)


def frame_bytes(dataset: h5py.Dataset) -> int:
    """What HDF5 adds to a file for another row of a chunked dataset: whole chunks, or nothing."""
    if dataset.shape[0] % dataset.chunks[0]:
        return 0
    chunks = math.prod(-(-extent // chunk) for extent, chunk in zip(dataset.shape[1:], dataset.chunks[1:]))
    return chunks * (math.prod(dataset.chunks) * dataset.dtype.itemsize + INDEX_BYTES)
