"""Products: HDF5 files that are complete or absent, describe themselves, and are written by all ranks together.

`io/new_files.py` describes how they are written. Each rank reads independently.
"""

import json
import math
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from mpi4py import MPI

from eddies.io.damage import checked_attributes, naming_damage, open_to_read
from eddies.io.errors import ProductError, file_errors, read_errors, remedy_for
from eddies.io.new_files import (HEADER_BYTES, chunk_bytes, frame_bytes, new_file, python_value, set_attributes,
                                 writes_first, writing)
from eddies.io.provenance import FORMAT, environment, has_this_format, product_ids, read_json, read_provenance
from eddies.io.units import conventions
from eddies.parallel.broadcast import on_all_ranks, on_first_rank
from eddies.pipeline import MAKER_OF

CHUNK_BYTES = 2**20
FEW = 9  # a chunk holds many frames if a frame has at most this number of values
SERIES = "particles/", "fields/"  # groups whose datasets have frames
File = h5py.File
Result = TypeVar("Result")


class Table(dict[str, Any]):
    """Columns of a table by name, with attributes of their datasets.

    axes : names of the axes of the columns. A column with fewer axes has the first of them, and a column with the name
        of an axis has only that one.
    units : units by column.
    """

    def __init__(self, columns: Mapping[str, Any], axes: str = "row", units: Mapping[str, str] | None = None) -> None:
        super().__init__(columns)
        self.axes, self.units = axes, dict(units or {})


def in_files(comm: MPI.Comm, path: Path, work: Callable[[], Result]) -> Result:
    """Call `work`, which uses the files at `path`, on rank 0, and return its result on all ranks.

    If `work` raises UserError, all ranks raise it. If it raises OSError, all ranks raise WriteError.
    """
    with file_errors(path):
        return on_first_rank(comm, work)


@contextmanager
def create_product(comm: MPI.Comm, path: str | Path, kind: str,
                   provenance: Mapping[str, Any]) -> Iterator[h5py.File]:
    """Write a product, all ranks together. It appears under `path` after the block has ended without an exception.

    `provenance` holds the scene's text, its fingerprint and more values that JSON can store. It is stored with the
    versions of all libraries, the number of ranks, the date and a new id. If it holds `made_from`, a list of
    kinds of products, the ids of these products in the same directory are stored instead of the list. If it holds `id`,
    the product gets this id, not a new one. A file that replaces a product can thus keep the id of that product, which
    other products may name as their origin.

    Raises:
        WriteError: on all ranks; the file cannot be written or renamed.
    """
    path = Path(path)
    with new_file(comm, path) as file:
        origin = on_first_rank(comm, lambda: json.dumps({
            **environment(comm.size), "id": uuid.uuid4().hex, **provenance,
            "made_from": product_ids(path.parent, provenance.get("made_from", ()))}))
        with writing(file, len(origin) + HEADER_BYTES):
            set_attributes(file, {"kind": kind, "format": FORMAT, "complete": False, "provenance": origin,
                                  **conventions(kind)})
        yield file
        with writing(file, HEADER_BYTES):
            file.attrs["complete"] = True


@contextmanager
def open_product(comm: MPI.Comm, path: str | Path, kind: str | None) -> Iterator[h5py.File]:
    """Open a complete product to read it. `kind` None allows any kind. An error of one rank is raised by all ranks.

    Raises:
        ProductError: the file is missing, truncated, not an HDF5 file, unfinished, or of another kind or format.
    """
    with on_all_ranks(comm, lambda: _open_checked(Path(path), kind), ProductError) as file, naming_damage(path):
        yield file


def read_attributes(file: h5py.Group, name: str) -> dict[str, Any]:
    """Return the attributes of a group as Python values; ProductError if there is no such group."""
    return {key: python_value(value) for key, value in find_group(file, name).attrs.items()}


def write_table(file: h5py.Group, name: str, columns: Mapping[str, Any]) -> None:
    """Write small arrays, equal on all ranks, as the datasets of a group; collective. Columns that are no `Table` have
    rows and no units."""
    with writing(file, HEADER_BYTES):
        group = file.create_group(name)
    table = columns if isinstance(columns, Table) else Table(columns)
    for column, values in table.items():
        values, axes = np.asarray(values), table.axes.split()
        own = [column] if column in axes else axes[:values.ndim]
        write_array(group, column, values, " ".join(own), table.units.get(column, ""))


def write_array(group: h5py.Group, name: str, values: np.ndarray, axes: str = "", units: str = "") -> None:
    """Write an array, equal on all ranks, as a dataset; collective. `axes` and `units` become its attributes."""
    dataset = empty_dataset(group, name, values.shape, values.dtype, axes, units)
    if values.ndim == 0:
        dataset[()] = values
    elif values.size:
        with writing(group, 0):  # data with checksums are written collectively; rank 0 writes all of them
            own = np.ascontiguousarray(values if writes_first(group) else values[:0])
            write_block(dataset, own, (0,) * values.ndim)


def read_table(file: h5py.Group, name: str) -> Table:
    """Read what `write_table` wrote; ProductError if there is no such table."""
    group = find_group(file, name)
    columns = {column: dataset for column, dataset in group.items() if isinstance(dataset, h5py.Dataset)}
    axes = max((python_value(dataset.attrs.get("axes", "")) for dataset in columns.values()), key=len, default="")
    return Table({column: dataset[()] for column, dataset in columns.items()}, axes,
                 {column: python_value(dataset.attrs["units"]) for column, dataset in columns.items()
                  if "units" in dataset.attrs})


def find_group(file: h5py.Group, name: str) -> h5py.Group:
    """Return the group `name`. If there is no such group, raise a ProductError that lists what `file` holds."""
    group = file.get(name)
    if not isinstance(group, h5py.Group):
        raise ProductError(f"{file.file.filename}: holds no {name}; its group {file.name} holds "
                           f"{', '.join(file) or 'nothing'}")
    return group


def stored_numbers(file: h5py.File) -> Iterator[tuple[str, int | None, np.ndarray]]:
    """Yield all floating-point numbers of an open product: for each dataset and attribute its name, a frame and values.

    Of a series, only the last frame is yielded. For all other numbers, attributes included, the frame is None.
    """
    names: list[str] = []
    file.visit(names.append)
    for name in names:
        item = file[name]
        for attribute, value in checked_attributes(item).items():
            if np.asarray(value).dtype.kind == "f":
                yield f"{name}, attribute {attribute}", None, np.asarray(value)
        if isinstance(item, h5py.Dataset) and item.dtype.kind == "f" and item.size:
            if name.startswith(SERIES) and item.maxshape[0] is None:
                yield name, len(item) - 1, item[-1]
            else:
                yield name, None, item[()]


def growing_dataset(group: h5py.Group, name: str, frame_shape: tuple[int, ...], dtype: Any, axes: str = "",
                    units: str = "") -> h5py.Dataset:
    """Create an empty dataset (frames, *frame_shape) for `append_frame`; collective. `axes` and `units` become its
    attributes.

    A chunk holds part of a frame, or many frames if a frame has few values.
    """
    values = math.prod(frame_shape)
    frames = 256 // values if 0 < values <= FEW else 1
    with writing(group, HEADER_BYTES):
        dataset = group.create_dataset(name, (0, *frame_shape), dtype, maxshape=(None, *frame_shape), fletcher32=True,
                                       chunks=(frames, *chunk_of(frame_shape, dtype)))
        _describe(dataset, axes, units)
    return dataset


def empty_dataset(group: h5py.Group, name: str, shape: tuple[int, ...], dtype: Any, axes: str = "",
                  units: str = "") -> h5py.Dataset:
    """Create a dataset whose values are written later; collective. Its chunks have checksums. A single number is
    stored in the header of the dataset, which has a checksum. `axes` and `units` become its attributes."""
    chunk = chunk_of(shape, dtype)
    with writing(group, HEADER_BYTES + chunk_bytes(shape, chunk, np.dtype(dtype).itemsize)):
        if shape and math.prod(shape):
            dataset = group.create_dataset(name, shape, dtype, chunks=chunk, fletcher32=True)
        else:
            compact = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
            compact.set_layout(h5py.h5d.COMPACT)
            space = h5py.h5s.create_simple(shape) if shape else h5py.h5s.create(h5py.h5s.SCALAR)
            dataset = h5py.Dataset(h5py.h5d.create(group.id, name.encode(), h5py.h5t.py_create(np.dtype(dtype)), space,
                                                   compact))
        _describe(dataset, axes, units)
    return dataset


def chunk_of(shape: tuple[int, ...], dtype: Any) -> tuple[int, ...]:
    """Return the shape of a chunk of at most about 1 MiB."""
    largest = CHUNK_BYTES // np.dtype(dtype).itemsize
    return tuple(max(1, min(extent, largest // max(math.prod(shape[axis + 1:]), 1)))
                 for axis, extent in enumerate(shape))


def append_frame(dataset: h5py.Dataset, block: np.ndarray, offset: tuple[int, ...]) -> None:
    """Add a frame to a growing dataset. This rank writes `block`, which may be empty, at `offset`; collective."""
    frame, block = dataset.shape[0], np.asarray(block, dataset.dtype, order="C")
    with writing(dataset, frame_bytes(dataset)):
        dataset.resize(frame + 1, axis=0)
        write_block(dataset, block[None], (frame, *offset))


def write_block(dataset: h5py.Dataset, block: np.ndarray, offset: tuple[int, ...]) -> None:
    """Write a block, which may be empty, at an offset of a dataset; collective, inside a `writing` block."""
    in_file, in_memory = dataset.id.get_space(), h5py.h5s.create_simple(block.shape)
    if block.size:
        in_file.select_hyperslab(offset, block.shape)
    else:
        in_file.select_none()
        in_memory.select_none()
    transfer = h5py.h5p.create(h5py.h5p.DATASET_XFER)
    if dataset.file.driver == "mpio":
        transfer.set_dxpl_mpio(h5py.h5fd.MPIO_COLLECTIVE)
    dataset.id.write(in_memory, in_file, block, dxpl=transfer)


def read_frame(dataset: h5py.Dataset, frame: int, selection: tuple[slice, ...], limit: float = np.inf) -> np.ndarray:
    """Read the part `selection` of one frame; the dataset holds floating-point numbers.

    Raises ProductError, on this rank only, if a number is not finite. If `limit` is finite, a number outside the range
    0 to `limit` is an error, too. In a rollout, numbers that are not finite are allowed, because a rollout may end
    with them.
    """
    values, place = dataset[frame, *selection], f"frame {frame % len(dataset)}: holds values that are"
    if not np.isfinite(values).all() and python_value(dataset.file.attrs["kind"]) != "rollout":
        raise unfit(dataset, f"{place} not finite")
    if limit < np.inf and np.any((values < 0) | (values > limit)):
        raise unfit(dataset, f"{place} outside the range 0 to {limit:.6g}")
    return values


def read_times(dataset: h5py.Dataset) -> np.ndarray:
    """Return the times of a series; ProductError if they do not increase."""
    times = dataset[()]
    if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
        raise unfit(dataset, "holds times that do not increase")
    return times


def unfit(dataset: h5py.Dataset, problem: str) -> ProductError:
    """Return the error for a dataset with content that no stage writes."""
    kind = python_value(dataset.file.attrs["kind"])
    return ProductError(f"{dataset.file.filename}: {dataset.name}, {problem}; {remedy_for(kind)}")


def _describe(dataset: h5py.Dataset, axes: str, units: str) -> None:
    """Write the attributes `axes` and `units` of a dataset, unless they are empty; collective."""
    set_attributes(dataset, {name: words for name, words in (("axes", axes), ("units", units)) if words})


def _open_checked(path: Path, kind: str | None) -> h5py.File:
    remedy = f"run `eddies {MAKER_OF[kind].name} SCENE` first" if kind in MAKER_OF else "make it first"
    with read_errors(path):
        if path.is_dir():
            raise ProductError(f"{path}: is a directory, not a file; move it away, then {remedy}")
        if not path.is_file():
            raise ProductError(f"{path}: no such file; {remedy}")
        file = open_to_read(path)
    try:
        if problem := _problem(file, kind, remedy):
            raise ProductError(f"{path}: {problem}")
        read_provenance(file)
        return file
    except BaseException:
        file.close()
        raise


def _problem(file: h5py.File, kind: str | None, remedy: str) -> str | None:
    """Return why an open file is not a complete product of this `kind`, with a remedy; None if it is one. `remedy` is
    the remedy for a file of another kind and for an unfinished file."""
    try:
        stored = str(python_value(file.attrs.get("kind", "unknown")))
        complete = bool(file.attrs.get("complete", False))
    except (OSError, TypeError, ValueError) as error:
        return f"damaged, its attributes cannot be read ({error}); make it again, or give another file"
    if kind not in (None, stored):
        return f"is of kind {stored}, expected {kind}: {remedy}"
    if not complete:
        return f"unfinished, its writer was stopped: {remedy}"
    if not has_this_format(file):
        version = read_json(file, "provenance").get("eddies", "of unknown version")
        name = stored.replace("_", " ")
        return f"written by eddies {version}, whose {name} this version does not read; {remedy_for(stored)}"
    return None
