"""Files that appear under their name only when they are complete.

Everything is written to NAME.partial, which is renamed at the end. A full disk, an error or an interrupt therefore
leaves the former file as it was. There are two ways to write:

- `write_files`: small files (JSON, pages, pictures), by one rank.
- `new_file`: an HDF5 file, by all ranks together; `create_export` is a short form for files of other programs.

HDF5 does not survive a write that fails: it crashes when it closes the file, or ranks wait for each other for ever.
Four measures keep failures away from it:

1. Each write is announced by `writing`, which reserves the space on the disk first. If there is too little, all ranks
   raise WriteError before HDF5 writes; the file can then be closed and removed. A margin stays reserved for what HDF5
   writes at the end.
2. A file that one rank writes lies on a `Sink`, which hides failures from HDF5 and reports them to us. This covers
   file systems that cannot reserve space.
3. If h5py is built without MPI, as its wheels are, rank 0 writes for all: `own_part` sends it the blocks of the other
   ranks. These have a file in memory with the same groups, attributes and shapes, so callers see no difference.
4. If several ranks share a file, closing it is collective. After an exception that other ranks may not know of, the
   file is left open, as NAME.partial, and the job is aborted.

A job may lose its run directory to another one (io/run_lock.py), which then writes a NAME.partial of its own. So a file
is renamed or removed only if it still is the file that this job created.
"""

from __future__ import annotations

import errno
import io
import json
import math
import os
import resource
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from eddies.io.checksums import add_checksums
from eddies.io.errors import ProductError, WriteError, file_errors, room, write_error
from eddies.io.run_lock import RunTakenOver
from eddies.parallel.broadcast import on_all_ranks, on_first_rank
from eddies.parallel.stop import Stopped

# Upper limits of what HDF5 writes beside the values: for a dataset, for a chunk, and when it closes a file.
HEADER_BYTES, INDEX_BYTES, MARGIN_BYTES = 2**14, 2**8, 2**19
# Largest product if rank 0 writes for all: it holds one frame in memory, and the others wait.
LARGEST_BYTES = 4 * 10**9
REMEDY = ("run on one rank, or build h5py with MPI: `CC=mpicc HDF5_MPI=ON pip install --no-binary=h5py "
          "--no-build-isolation h5py`")

Layout = Mapping[str, tuple[tuple[int, ...], Any]]  # shape and type of each large dataset

# The files that are being written, by the name that HDF5 has for them.
_open: dict[str, _NewFile] = {}
# Files left open after an error, until the process ends: Python must not close them on one rank alone.
_abandoned: list[_NewFile] = []


def write_files(contents: Mapping[Path, bytes | str]) -> None:
    """Write small files on one rank. All get their names after all have been written.

    Raises WriteError; files that were there are then unchanged.
    """
    partials = {path: path.with_name(path.name + ".partial") for path in contents}
    whole = {path: content.encode() if isinstance(content, str) else content for path, content in contents.items()}
    total = sum(map(len, whole.values()))
    try:
        for path, partial in partials.items():
            with file_errors(path, total):
                partial.write_bytes(whole[path])
        for path, partial in partials.items():
            with file_errors(path, total):
                os.replace(partial, path)
    finally:
        for partial in partials.values():
            if partial.is_file():
                partial.unlink()


@contextmanager
def new_file(comm: MPI.Comm, path: Path, checksums: bool = True) -> Iterator[h5py.File]:
    """Write an HDF5 file, all ranks together. It appears under `path` after the block has ended without an exception.

    Raises WriteError on all ranks if the file cannot be written or renamed.
    """
    new = _NewFile(comm, path.with_name(path.name + ".partial"))
    try:
        yield new.file
        with writing(new.file, 0):
            new.close()
        with file_errors(path):
            if checksums and on_first_rank(comm, new.is_own):
                add_checksums(comm, new.path)
    except BaseException as error:
        if comm.size > 1 and not isinstance(error, Stopped | WriteError | RunTakenOver):
            new.abandon()
        else:
            new.close()
            with file_errors(new.path):
                on_first_rank(comm, new.remove)
            new.check()
        raise
    with file_errors(path):
        on_first_rank(comm, lambda: new.publish(path))
    comm.Barrier()


@contextmanager
def create_export(path: Path, layout: Layout, provenance: Mapping[str, Any], overhead: int = 0) -> Iterator[h5py.File]:
    """Write an HDF5 file for other programs, on one rank. It has empty datasets and the provenance of a product.

    All space is reserved at the beginning: for the datasets and `overhead` bytes of others. The directory is made if it
    is missing. Raises WriteError.
    """
    with file_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    size = sum(math.prod(shape) * np.dtype(dtype).itemsize for shape, dtype in layout.values())
    with new_file(MPI.COMM_SELF, path, checksums=False) as file:
        with writing(file, size + overhead):  # the margin suffices for the rest
            file.attrs["provenance"] = json.dumps(dict(provenance))
            for name, (shape, dtype) in layout.items():
                file.create_dataset(name, shape, dtype)
        yield file


@contextmanager
def writing(group: h5py.Group | h5py.Dataset, size: int) -> Iterator[None]:
    """Write at most `size` bytes to a new file inside the block; the same size on all ranks.

    Raises:
        WriteError: on all ranks; the disk is full.
        ProductError: on this rank; HDF5 failed although the space was reserved.
    """
    new = _open[group.file.filename]
    new.take(size)
    try:
        yield
    except (OSError, RuntimeError) as error:
        new.check()
        new.broken = True
        raise ProductError(f"{new.path}: cannot be written: {error}: {room(new.path, size)}; make room, or check the "
                           "disk, then run the command again") from None
    new.check()


def writing_failed() -> bool:
    """Whether HDF5 failed to write a file that ranks share. The process then crashes unless it is aborted."""
    return any(new.broken for new in _abandoned)


def has_single_writer(comm: MPI.Comm) -> bool:
    """Whether rank 0 writes for several ranks, because h5py is built without MPI."""
    return comm.size > 1 and not h5py.get_config().mpi


def own_part(group: h5py.Group | h5py.Dataset, shape: tuple[int, ...], block: np.ndarray,
             offset: tuple[int, ...]) -> tuple[np.ndarray, tuple[int, ...]]:
    """The part of an array that this rank writes, and its offset: its block or, if rank 0 writes for all, the whole
    array of this `shape` on rank 0 and nothing on the others; collective."""
    comm = _open[group.file.filename].comm
    if not has_single_writer(comm) or not shape:
        return block, offset
    places = np.empty((comm.size, 2, len(shape)), np.int64)
    comm.Gather(np.array([offset, block.shape], np.int64), places)
    start = (0,) * len(shape)
    if comm.rank > 0:
        if block.size:
            comm.Send(block, 0)
        return np.empty(start, block.dtype), start
    whole = np.zeros(shape, block.dtype)
    for rank, (begin, extent) in enumerate(places):
        if extent.all():
            part = block if rank == 0 else np.empty(extent, block.dtype)
            if rank > 0:
                comm.Recv(part, rank)
            whole[tuple(map(slice, begin, begin + extent))] = part
    return whole, start


def frame_bytes(dataset: h5py.Dataset) -> int:
    """The bytes that a file grows by if a chunked dataset gets another row."""
    if dataset.shape[0] % dataset.chunks[0]:
        return 0
    chunks = math.prod(-(-extent // chunk) for extent, chunk in zip(dataset.shape[1:], dataset.chunks[1:]))
    return chunks * (math.prod(dataset.chunks) * dataset.dtype.itemsize + INDEX_BYTES)


class Sink(io.FileIO):
    """A new file for h5py.File(sink, "w"). HDF5 sees no failure: the first one is kept, later writes are dropped."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "w+")
        self.path = path
        self.failure: WriteError | None = None

    def __repr__(self) -> str:
        return str(self.path)  # h5py takes it as the name of the file

    def write(self, data) -> int:
        """Write all bytes, or keep the failure."""
        rest = memoryview(data)
        with self._kept(len(rest)):
            while rest and self.failure is None:
                rest = rest[super().write(rest):]
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        """Set the length of the file, or keep the failure."""
        with self._kept(size or 0):
            super().truncate(size)
        return size or 0

    def close(self) -> None:
        """Close the file, or keep the failure: some file systems report it only then."""
        with self._kept(0):
            super().close()

    def check(self) -> None:
        """Raise the failure, if there was one."""
        if self.failure is not None:
            raise self.failure

    @contextmanager
    def _kept(self, wanted: int) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.failure = self.failure or write_error(self.path, error, wanted)


class _NewFile:
    """An HDF5 file that all ranks write together. All methods are collective, unless they say otherwise."""

    def __init__(self, comm: MPI.Comm, path: Path) -> None:
        self.comm, self.path, self.broken = comm, path, False
        self._needed, self._held = 0, 0
        self._sink: Sink | None = None
        self._together = comm.size > 1 and not has_single_writer(comm)
        if self._together:
            self._alike(self._make_empty)
            self._alike(self._open_together)
        else:
            self._alike(self._open_sink if comm.rank == 0 else self._open_in_memory)
        self._inode = path.stat().st_ino if comm.rank == 0 else 0
        self._name = self.file.filename
        _open[self._name] = self

    def take(self, size: int) -> None:
        """Reserve space for `size` more bytes, beside those of earlier calls. WriteError on all ranks."""
        self._needed += size
        if self._needed + MARGIN_BYTES > self._held:
            stop = self._needed + 2 * MARGIN_BYTES
            self._alike(lambda: self._reserve(stop))
            self._held = stop

    def check(self) -> None:
        """Raise WriteError on all ranks if the only writer has failed."""
        if not self._together:
            on_all_ranks(self.comm, lambda: self._sink and self._sink.check(), WriteError)

    def close(self) -> None:
        """Close the file. HDF5 cuts off the space that it does not need."""
        _open.pop(self._name, None)
        self.file.close()
        if self._sink is not None:
            self._sink.close()

    def abandon(self) -> None:
        """Leave the file in place, and open if closing it is collective. One rank may call it alone."""
        if self._together:
            _open.pop(self._name, None)
            _abandoned.append(self)
        else:
            self.close()

    def is_own(self) -> bool:
        """Whether the file is still the one that this job created; on rank 0."""
        return self.path.exists() and self.path.stat().st_ino == self._inode

    def remove(self) -> None:
        """Remove the closed file; on rank 0."""
        if self.is_own():
            self.path.unlink()

    def publish(self, path: Path) -> None:
        """Give the closed file its name; on rank 0."""
        if not self.is_own():
            raise RunTakenOver(f"{path}: another job has taken this run directory over; this job ends and leaves all "
                               "files as they are")
        os.replace(self.path, path)

    def _open_sink(self) -> None:
        self._sink = Sink(self.path)
        self.file = h5py.File(self._sink, "w")

    def _open_in_memory(self) -> None:
        self.file = h5py.File(self.path, "w", driver="core", backing_store=False)

    def _make_empty(self) -> None:
        """Write an empty HDF5 file on rank 0. Without it, HDF5 could not even close the file on a full disk."""
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
        check_limit(stop)
        if self.comm.rank == 0:
            with open(self.path, "r+b", buffering=0) as file:
                reserve(file.fileno(), self._held, stop)

    def _alike(self, work: Callable[[], None]) -> None:
        """Do work that may fail on some ranks. All ranks raise the WriteError of the lowest of them."""
        def guarded() -> None:
            with file_errors(self.path, max(self._needed + 2 * MARGIN_BYTES - self._held, 0)):
                work()

        on_all_ranks(self.comm, guarded, WriteError)


def reserve(descriptor: int, start: int, stop: int) -> None:
    """Reserve the bytes from start to stop of an open file on the disk; the file gets at least this length.

    Raises OSError if the disk is full. If the file system cannot reserve space, this compares with its free space.
    """
    try:
        os.posix_fallocate(descriptor, start, stop - start)
    except OSError as error:
        if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL):
            raise
        disk = os.fstatvfs(descriptor)
        if disk.f_bavail * disk.f_frsize < stop - start:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) from None


def check_limit(size: int) -> None:
    """Raise OSError if this process may not write files of this size."""
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    if limit != resource.RLIM_INFINITY and size > limit:
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))
