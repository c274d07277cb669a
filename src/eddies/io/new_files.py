"""Files that appear under their name only when they are complete.

Everything is written to NAME.partial, which is renamed at the end. A full disk, an error or an interrupt therefore
leaves the former file as it was. There are two ways to write:

- `write_files`: small files (JSON, pages, pictures), by one rank.
- `new_file`: an HDF5 file, by all ranks together; `create_export` uses it for files that other programs read.

HDF5 does not survive a write that fails: it crashes when it closes the file, or ranks wait for each other for ever.
Two measures prevent this:

1. Each write is announced by `writing`, which reserves the space on the disk first. If there is too little, all ranks
   raise WriteError before HDF5 writes; the file can then be closed and removed. A margin stays reserved for what HDF5
   writes at the end.
2. If a write fails nevertheless, or one of several ranks raises an exception that the others may not know of, the file
   is left open, as NAME.partial, and the job is aborted.
"""

from __future__ import annotations

import errno
import io
import json
import math
import os
import resource
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import numpy as np
from mpi4py import MPI

from eddies.errors import UserError
from eddies.io.damage import LAYOUT
from eddies.io.errors import ProductError, WriteError, file_errors, space_in_words
from eddies.parallel.broadcast import first_complaint, on_all_ranks, on_first_rank
from eddies.parallel.stop import Stopped

# Upper limits of the bytes that HDF5 adds to the values: for a dataset, for a chunk, and when it closes a file.
HEADER_BYTES, INDEX_BYTES, MARGIN_BYTES = 2**14, 2**8, 2**19

Layout = Mapping[str, tuple[tuple[int, ...], Any]]  # shape and type of each large dataset, by its path

# The files that are being written, by their names in HDF5.
_open: dict[str, _NewFile] = {}
# Files that stay open after an error until the process ends. If one were closed, HDF5 would crash or a rank would wait.
_abandoned: list[_NewFile] = []


def write_files(contents: Mapping[Path, bytes | str]) -> None:
    """Write small files on one rank, texts in UTF-8. They get their names after all of them have been written.

    A byte of a file name that is not UTF-8 is written into a text as an escape, such as "\\udcff".
    Raises WriteError if a file cannot be written or renamed. If one cannot be written, no existing file is changed.
    """
    partials = {path: path.with_name(path.name + ".partial") for path in contents}
    whole = {path: content.encode(errors="backslashreplace") if isinstance(content, str) else content
             for path, content in contents.items()}
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
def new_file(comm: MPI.Comm, path: Path) -> Iterator[h5py.File]:
    """Write an HDF5 file, all ranks together. It appears under `path` after the block has ended without an exception.

    Raises WriteError on all ranks if the file cannot be written or renamed.
    """
    new = _NewFile(comm, path.with_name(path.name + ".partial"))
    try:
        yield new.file
        with writing(new.file, 0):
            new.close()
        with file_errors(path):
            comm.Barrier()  # all ranks have closed the file
            on_all_ranks(comm, lambda: _force_to_disk(new.path))  # on every node
    except BaseException as error:
        _open.pop(new.name, None)
        all_raise = comm.size == 1 or isinstance(error, Stopped | WriteError)
        if new.broken or not all_raise or not new.try_to_close():
            _abandoned.append(new)
        else:
            with file_errors(new.path):
                on_first_rank(comm, lambda: new.path.unlink(missing_ok=True))
        raise
    with file_errors(path):
        on_first_rank(comm, lambda: new.publish(path))
    comm.Barrier()


@contextmanager
def create_export(path: Path, layout: Layout, provenance: Mapping[str, Any], overhead: int = 0) -> Iterator[h5py.File]:
    """Write an HDF5 file for other programs, on one rank. It has the empty datasets of `layout` and a provenance.

    All space is reserved at the beginning: for the datasets, and `overhead` bytes for the rest. The directory is made
    if it is missing. Raises WriteError.
    """
    with file_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    size = sum(math.prod(shape) * np.dtype(dtype).itemsize for shape, dtype in layout.values())
    with new_file(MPI.COMM_SELF, path) as file:
        with writing(file, size + overhead):  # the margin has room for headers and attributes
            set_attributes(file, {"provenance": json.dumps(dict(provenance))})
            for name, (shape, dtype) in layout.items():
                file.create_dataset(name, shape, dtype)
        yield file


@contextmanager
def writing(group: h5py.Group | h5py.Dataset, size: int) -> Iterator[None]:
    """Reserve `size` bytes of a new file, equal on all ranks. The caller may write them inside the block.

    Raises:
        WriteError: on all ranks; the disk is full.
        ProductError: on this rank; HDF5 failed although the space was reserved.
    """
    new = _open[group.file.filename]
    new.reserve(size)
    try:
        yield
    except (OSError, RuntimeError) as error:
        new.broken = True
        raise ProductError(f"{new.path}: cannot be written: {error}: {space_in_words(new.path, size)}; make room, or "
                           "check the disk, then run the command again") from None


def writes_first(group: h5py.Group | h5py.Dataset) -> bool:
    """Return whether this rank is the first of those that write the file."""
    return _open[group.file.filename].comm.rank == 0


def writing_failed() -> bool:
    """Return whether HDF5 failed to write a file. The process then crashes at its end unless it is aborted."""
    return any(new.broken for new in _abandoned)


def require_parallel_hdf5(comm: MPI.Comm) -> None:
    """Raise UserError if there are several ranks and h5py was built without MPI, as its wheels are."""
    if comm.size > 1 and not h5py.get_config().mpi:
        raise UserError(f"{comm.size} ranks need an h5py with MPI, and this one has none; run mpi_tools/bootstrap.sh, "
                        "or `CC=mpicc HDF5_MPI=ON pip install --no-binary=h5py --no-build-isolation h5py`; one rank "
                        "works with any h5py")


def set_attributes(item: h5py.Group | h5py.Dataset, values: Mapping[str, Any]) -> None:
    """Set attributes of a group or dataset; collective. Texts are stored with a fixed length, in UTF-8, because HDF5
    has no checksum of texts of variable length."""
    for name, value in values.items():
        if isinstance(value, str):
            text = value.encode()
            item.attrs.create(name, text, dtype=h5py.string_dtype("utf-8", max(len(text), 1)))
        else:
            item.attrs[name] = value


def python_value(value: Any) -> Any:
    """Return a number or text of an attribute as a Python object."""
    if isinstance(value, bytes):
        return value.decode()
    return value.item() if isinstance(value, np.generic) else value


def frame_bytes(dataset: h5py.Dataset) -> int:
    """Return an upper limit of the bytes by which a file grows when a chunked dataset gets one more frame."""
    if dataset.shape[0] % dataset.chunks[0]:
        return 0
    return chunk_bytes(dataset.shape[1:], dataset.chunks[1:], dataset.chunks[0] * dataset.dtype.itemsize)


def chunk_bytes(shape: tuple[int, ...], chunk: tuple[int, ...], itemsize: int) -> int:
    """Return an upper limit of the bytes of an array in chunks. HDF5 stores each chunk in full."""
    chunks = math.prod(-(-extent // part) for extent, part in zip(shape, chunk))
    return chunks * (math.prod(chunk) * itemsize + INDEX_BYTES)


class _NewFile:
    """An HDF5 file that all ranks write together. `reserve`, `close` and `try_to_close` are collective; only rank 0
    calls `publish`."""

    def __init__(self, comm: MPI.Comm, path: Path) -> None:
        self.comm, self.path, self.broken = comm, path, False
        self._needed, self._reserved = 0, 0
        self._alike(self._make_empty)
        self._alike(self._open_file)
        self.name = self.file.filename
        _open[self.name] = self

    def reserve(self, size: int) -> None:
        """Reserve space for `size` bytes more than before. WriteError, on all ranks, if there is too little."""
        self._needed += size
        if self._needed + MARGIN_BYTES > self._reserved:
            stop = self._needed + 2 * MARGIN_BYTES
            self._alike(lambda: self._reserve_until(stop))
            self._reserved = stop

    def close(self) -> None:
        """Close the file. HDF5 cuts off the space that it does not need."""
        _open.pop(self.name, None)
        self.file.close()
        if self._stream is not None:
            self._stream.close()

    def try_to_close(self) -> bool:
        """Close the file after an error, without raising another error. Returns whether all ranks have closed it."""
        complaint = None
        try:
            self.close()
        except (OSError, RuntimeError) as error:
            complaint = str(error)
        self.broken = first_complaint(self.comm, complaint) is not None
        return not self.broken

    def publish(self, path: Path) -> None:
        """Give the closed file its final name, `path`."""
        os.replace(self.path, path)
        with suppress(OSError):  # the file is complete; some file systems do not allow fsync of a directory
            _force_to_disk(path.parent)

    def _make_empty(self) -> None:
        """Write an empty HDF5 file on rank 0. Without it, HDF5 could not even close the file on a full disk."""
        if self.comm.rank == 0:
            empty = io.BytesIO()
            h5py.File(empty, "w", libver=LAYOUT).close()
            try:
                # Make a new inode: a file left open after an error may still use the old one.
                self.path.unlink(missing_ok=True)
                self.path.write_bytes(empty.getvalue())
            except OSError:
                self.path.unlink(missing_ok=True)
                raise

    def _open_file(self) -> None:
        self._stream: BinaryIO | None = None
        if self.comm.size > 1:
            self.file = h5py.File(self.path, "r+", driver="mpio", comm=self.comm, libver=LAYOUT)
        else:
            # With a file object of Python, HDF5 uses no file lock, which some network file systems lack.
            self._stream = open(self.path, "r+b")
            self.file = h5py.File(self._stream, "r+", libver=LAYOUT)

    def _reserve_until(self, stop: int) -> None:
        limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]  # of this process
        if limit != resource.RLIM_INFINITY and stop > limit:
            raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))
        if self.comm.rank == 0:
            with open(self.path, "r+b", buffering=0) as file:
                try:
                    os.posix_fallocate(file.fileno(), self._reserved, stop - self._reserved)
                except OSError as error:
                    if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL):  # this file system cannot reserve space
                        raise

    def _alike(self, work: Callable[[], None]) -> None:
        """Do work that may fail on some ranks. All ranks raise the WriteError of the lowest rank that failed."""
        def guarded() -> None:
            with file_errors(self.path, self._needed + 2 * MARGIN_BYTES - self._reserved):
                work()

        on_all_ranks(self.comm, guarded, WriteError)


def _force_to_disk(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
