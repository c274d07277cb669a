"""Products: HDF5 files that are complete or absent, say what they are, and are written by all ranks together.

A product is written under a temporary name, marked complete, closed, and only then renamed: never half written. Writing
uses parallel HDF5 on several ranks, or rank 0 where there is none (io/single_writer.py), in room taken before
(io/unfinished.py); every rank reads by itself.
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from mpi4py import MPI

from eddies.io.checksums import ATTRIBUTE, WORDS
from eddies.io.errors import ProductError, WriteError, make_again, write_error
from eddies.io.provenance import FORMAT, environment, has_this_format, identity, read_json, read_provenance
from eddies.io.quantities import conventions, describe
from eddies.io.reading import cannot_be_read, open_to_read, why_unreadable
from eddies.io.run_lock import RunTakenOver
from eddies.io.unfinished import HEADER_BYTES, Unfinished, frame_bytes, writing, written_here
from eddies.parallel.broadcast import on_first_rank, share_text
from eddies.parallel.stop import Stopped
from eddies.pipeline import MAKER_OF

CHUNK_BYTES = 2**20
# The type of an open product.
File = h5py.File
Result = TypeVar("Result")


def in_files(comm: MPI.Comm, path: Path, work: Callable[[], Result]) -> Result:
    """What work with the files at `path` gives that rank 0 does alone, on every rank; all ranks call it.

    Raises on all ranks the UserError of the work, or a WriteError where a file cannot be written, read or removed.
    """
    try:
        return on_first_rank(comm, work)
    except OSError as error:
        raise write_error(path, error, f"{error.filename or path}: {error.strerror or error}; check the file, its "
                          "directory and the space on the disk") from None


@contextmanager
def create_product(comm: MPI.Comm, path: str | Path, kind: str,
                   provenance: Mapping[str, Any]) -> Iterator[h5py.File]:
    """Write a product, all ranks together; the file appears under `path` once the block ends well.

    `provenance` (JSON-able: the scene's text, its fingerprint, ...) is stored with the versions of all
    libraries, the number of ranks, the date and an id; of the kinds in its `made_from` those that lie beside the file,
    with their ids. An `id` in it is kept: the file takes the place of one that others were made from, and would be made
    alike from this one. An exception inside the block leaves whatever stood under `path` untouched, and nothing beside
    it where all ranks know of it.

    Raises:
        WriteError: the file cannot be made or get its name, or there is no room for it.
    """
    path = Path(path)
    unfinished = Unfinished(comm, path.with_name(path.name + ".partial"))
    origin = share_text(comm, "" if comm.rank else json.dumps({
        **environment(comm.size), **provenance, **identity(path.parent, provenance.get("made_from", ())),
        **{key: value for key, value in provenance.items() if key == "id"}}))
    try:
        with writing(unfinished.file, len(origin) + HEADER_BYTES):
            write_attributes(unfinished.file,
                             {"kind": kind, "format": FORMAT, "complete": False, "provenance": origin,
                              ATTRIBUTE: WORDS, **conventions(kind)})
        yield unfinished.file
        with writing(unfinished.file, HEADER_BYTES):
            unfinished.file.attrs["complete"] = True
            unfinished.close()
        unfinished.add_checksums()
    except BaseException as error:
        # Several ranks close a file together: only where all of them are here.
        if comm.size > 1 and not isinstance(error, Stopped | WriteError | RunTakenOver):
            unfinished.abandon()
        else:
            unfinished.close()
            in_files(comm, unfinished.path, unfinished.remove)
            unfinished.check()
        raise
    in_files(comm, path, lambda: unfinished.publish(path))
    comm.Barrier()


@contextmanager
def open_product(comm: MPI.Comm, path: str | Path, kind: str | None) -> Iterator[h5py.File]:
    """Read a complete product of a kind (None: any); all ranks call it, and if one cannot open it, all raise.

    Raises:
        ProductError: no such file, truncated or not HDF5, unfinished, of another kind, or of another format.
    """
    file, problem = None, ""
    try:
        file = _open_checked(Path(path), kind)
    except ProductError as error:
        problem = str(error)
    failures = np.array([bool(problem)], np.int64)
    if comm.size > 1:
        comm.Allreduce(MPI.IN_PLACE, failures, MPI.SUM)
    if failures[0]:
        if file is not None:
            file.close()
        raise ProductError(problem or f"{path}: {failures[0]} of {comm.size} ranks cannot open this file")
    with file:
        yield file


def write_attributes(group: h5py.Group, values: Mapping[str, Any]) -> None:
    """Write numbers, strings and short lists of numbers as attributes; the same on every rank."""
    for name, value in values.items():
        group.attrs[name] = value


def read_attributes(file: h5py.Group, name: str) -> dict[str, Any]:
    """The attributes of a group as Python values; ProductError if there is no such group."""
    values = find_group(file, name).attrs.items()
    return {key: value.item() if isinstance(value, np.generic) else value for key, value in values}


def write_table(file: h5py.Group, name: str, columns: Mapping[str, Any]) -> None:
    """Write small arrays, equal on all ranks, as the datasets of a group; all ranks call it."""
    with writing(file, HEADER_BYTES):
        group = file.create_group(name)
    for column, values in columns.items():
        write_array(group, column, np.asarray(values))


def write_array(group: h5py.Group, name: str, values: np.ndarray) -> None:
    """Write an array, equal on all ranks, as a dataset; all ranks call it."""
    with writing(group, values.nbytes + HEADER_BYTES):
        describe(group.create_dataset(name, data=values))


def read_table(file: h5py.Group, name: str) -> dict[str, np.ndarray]:
    """Read what `write_table` wrote; ProductError lists the tables there are if this is none of them."""
    group = find_group(file, name)
    return {column: dataset[()] for column, dataset in group.items() if isinstance(dataset, h5py.Dataset)}


def find_group(file: h5py.Group, name: str) -> h5py.Group:
    """The group `name`; ProductError lists its neighbours if there is none."""
    group = file.get(name)
    if not isinstance(group, h5py.Group):
        raise ProductError(f"{file.file.filename}: holds no {name}; {file.name} holds: {', '.join(file) or 'nothing'}")
    return group


def growing_dataset(group: h5py.Group, name: str, frame_shape: tuple[int, ...], dtype: Any) -> h5py.Dataset:
    """An empty dataset (frames, *frame_shape) to which frames are added, in chunks of at most about 1 MiB: as much of
    one frame as fits, or many frames of a single value. All ranks call it."""
    chunk = _chunk(frame_shape, dtype) if frame_shape else (1024,)
    with writing(group, HEADER_BYTES):
        dataset = group.create_dataset(name, (0, *frame_shape), dtype, maxshape=(None, *frame_shape), chunks=chunk)
        describe(dataset)
    return dataset


def _chunk(frame_shape: tuple[int, ...], dtype: Any) -> tuple[int, ...]:
    chunk, largest = [1], CHUNK_BYTES // np.dtype(dtype).itemsize
    for axis, extent in enumerate(frame_shape):
        chunk.append(max(1, min(extent, largest // max(math.prod(frame_shape[axis + 1:]), 1))))
    return tuple(chunk)


def append_frame(dataset: h5py.Dataset, block: np.ndarray, offset: tuple[int, ...]) -> None:
    """Add a frame to a growing dataset; this rank writes `block` at `offset` within it.

    Collective: every rank calls it, also with an empty block.
    """
    frame = dataset.shape[0]
    block, offset = written_here(dataset, np.asarray(block, dataset.dtype, order="C"), offset)
    block, transfer = block[None], _collective(dataset.file)
    with writing(dataset, frame_bytes(dataset)):
        dataset.resize(frame + 1, axis=0)
        in_file, in_memory = dataset.id.get_space(), h5py.h5s.create_simple(block.shape)
        if block.size:
            in_file.select_hyperslab((frame, *offset), block.shape)
        else:
            in_file.select_none()
            in_memory.select_none()
        dataset.id.write(in_memory, in_file, block, dxpl=transfer)


def read_frame(dataset: h5py.Dataset, frame: int, selection: tuple[slice, ...], limit: float = np.inf) -> np.ndarray:
    """A part of a frame of floating-point numbers, or with a `limit` of such between 0 and this.

    ProductError, on this rank, where one of them is not finite, but a rollout may end with such a state, or beyond.
    """
    values, kind = dataset[frame, *selection], dataset.file.attrs["kind"]
    place = f"frame {frame % len(dataset)}: holds values that are"
    if kind != "rollout" and not np.isfinite(values).all():
        raise unfit(dataset, f"{place} not finite")
    if limit < np.inf and np.any((values < 0) | (values > limit)):
        raise unfit(dataset, f"{place} outside of 0 to {limit:.6g}")
    return values


def read_times(dataset: h5py.Dataset) -> np.ndarray:
    """The times of a series; ProductError where they do not increase."""
    times = dataset[()]
    if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
        raise unfit(dataset, "holds times that do not increase")
    return times


def unfit(dataset: h5py.Dataset, words: str) -> ProductError:
    """That a dataset is not what a stage writes, and what to do."""
    return ProductError(f"{dataset.file.filename}: {dataset.name}, {words}; {make_again(dataset.file.attrs['kind'])}")


def _collective(file: h5py.File) -> h5py.h5p.PropDXID:
    transfer = h5py.h5p.create(h5py.h5p.DATASET_XFER)
    if file.driver == "mpio":
        transfer.set_dxpl_mpio(h5py.h5fd.MPIO_COLLECTIVE)
    return transfer


def _open_checked(path: Path, kind: str | None) -> h5py.File:
    remedy = f"run `eddies {MAKER_OF[kind].name} SCENE` first" if kind in MAKER_OF else "make it first"
    try:
        if path.is_dir():
            raise ProductError(f"{path}: is a directory, not a file; move it away, then {remedy}")
        if not path.is_file():
            raise ProductError(f"{path}: no such file; {remedy}")
        file = open_to_read(path)
    except OSError as error:
        if reason := why_unreadable(error):
            raise ProductError(cannot_be_read(path, reason)) from None
        message = f"{path}: damaged or not an HDF5 file ({error}); delete it and make it again"
        raise ProductError(message) from None
    try:
        problem = _problem(file, kind, remedy)
        if problem is None:
            read_provenance(file)
            return file
        raise ProductError(f"{path}: {problem}")
    except BaseException:
        file.close()
        raise


def _problem(file: h5py.File, kind: str | None, remedy: str) -> str | None:
    """Why an open file is not to be read as a product of a kind, and what to do; None if it may be."""
    try:
        found, complete = str(file.attrs.get("kind", "unknown")), bool(file.attrs.get("complete", False))
    except (OSError, TypeError, ValueError) as error:
        return f"damaged, its attributes cannot be read ({error}); delete it and make it again"
    if kind not in (None, found):
        return f"is of kind {found}, expected {kind}: {remedy}"
    if not complete:
        return f"unfinished, its writer was stopped: {remedy}"
    if not has_this_format(file):
        version = read_json(file, "provenance").get("eddies", "of unknown version")
        what = found.replace("_", " ")
        return f"written by eddies {version}, whose {what} this version does not read; {make_again(found)}"
    return None
