"""Damaged HDF5 files. HDF5 finds changed bytes when it reads them.

All data that this package writes have a checksum in each chunk (`fletcher32`). Files have the layout of HDF5 1.10, in
which HDF5's own structure has checksums, too. Texts of attributes have a fixed length, because HDF5 stores those of
variable length without a checksum, and may crash when it reads damaged ones. The few texts of H5MD have a variable
length, as other programs expect; this package does not read them.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
from mpi4py import MPI

from eddies.io.errors import ContentError, ProductError, read_errors, remedy_for
from eddies.parallel.broadcast import on_all_ranks

LAYOUT = ("v110", "v110")  # the oldest layout whose structures all have checksums; any HDF5 since 1.10 reads it
MISSING = "missing"


def open_to_read(path: str | Path) -> h5py.File:
    """Open any HDF5 file for reading.

    HDF5's own file lock is not used, because some network file systems do not support it. It is not needed: a run
    directory has a lock, and a product gets its name only when it is complete.

    Raises ContentError if the file is missing or not an HDF5 file, and ProductError if the system refuses to open it.
    """
    with read_errors(path):
        return _opened(path)


@contextmanager
def naming_damage(path: str | Path) -> Iterator[None]:
    """Convert an error of HDF5 about damaged bytes inside the block to a ContentError that names dataset and frame."""
    try:
        yield
    except (OSError, KeyError, RuntimeError) as error:
        if isinstance(error, ProductError) or getattr(error, "errno", None) is not None or not _of_hdf5(error):
            raise
        place = _first_damage(Path(path), 0, 1)
        if place is None:
            raise
        raise ContentError(f"{path}: the file is damaged: {place}; {remedy_for(Path(path).stem)}") from None


def find_damage(comm: MPI.Comm, path: Path) -> str | None:
    """Read a whole file, each rank a part of its chunks; collective.

    Returns a text that names the file, the dataset and the frame of a damage, or None if there is no damage. If the
    system refuses to read the file, so that damage remains unknown, all ranks raise ProductError.
    """
    found = on_all_ranks(comm, lambda: _first_damage(path, comm.rank, comm.size), ProductError)
    place = next(filter(None, comm.allgather(found)), None)
    return None if place is None else f"{path}: {place if place == MISSING else f'the file is damaged: {place}'}"


def has_checksums(path: Path) -> bool:
    """Return whether all data of an undamaged file have checksums. Version 2.0.0 and those before wrote none that HDF5
    knows."""
    def bare(_: str, item: h5py.Group | h5py.Dataset) -> bool | None:
        return isinstance(item, h5py.Dataset) and bool(item.size) and not item.fletcher32 and (
            item.id.get_create_plist().get_layout() != h5py.h5d.COMPACT) or None

    with open_to_read(path) as file:
        return file.visititems(bare) is None


def checked_attributes(item: h5py.Group | h5py.Dataset) -> dict[str, Any]:
    """Return the attributes of a group or dataset, without texts of variable length."""
    return {name: item.attrs[name] for name in item.attrs
            if (text := h5py.check_string_dtype(item.attrs.get_id(name).dtype)) is None or text.length is not None}


def _opened(path: str | Path) -> h5py.File:
    return h5py.File(path, "r", locking=False)


def _of_hdf5(error: Exception) -> bool:
    return str(error).strip("'\"").startswith(("Can't", "Unable to"))


def _first_damage(path: Path, rank: int, ranks: int) -> str | None:
    """Return the dataset and frame of the first damage among this rank's chunks; "missing" without a file."""
    place = "the structure of the file"
    try:
        with read_errors(path), _opened(path) as file:
            names: list[str] = []
            file.visit(names.append)
            for name in (".", *names):
                place = f"the attributes of {name}"
                item = file[name]
                checked_attributes(item)
                if isinstance(item, h5py.Dataset):
                    for number, part in enumerate(item.iter_chunks() if item.chunks and item.size else [()]):
                        place = f"{name}, frame {part[0].start}" if part else name
                        if number % ranks == rank:
                            item[part]
    except ContentError:
        return place if path.is_file() else MISSING
    except (KeyError, RuntimeError, ValueError) as error:
        if isinstance(error, ProductError):
            raise
        return place
    return None
