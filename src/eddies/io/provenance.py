"""The origin of a product, stored in it as JSON: id, versions, commit, ranks, date and ids of what it was made from."""

import datetime
import functools
import json
import platform
from collections.abc import Callable, Iterable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

import eddies
from eddies.io.damage import open_to_read
from eddies.io.errors import ContentError, ProductError
from eddies.io.new_files import python_value
from eddies.kernels.library import in_use
from eddies.pipeline import MAKER_OF

# The format of products; other formats are not read. Files of format 1 (eddies 0.1) do not name their format. Since
# format 2, the scales of the flow are measured at the release of the tracers, and a model is a list of terms. Since
# format 3, the filter width has the name `filter_width`.
FORMAT = 3
LIBRARIES = ("numpy", "mpi4py", "h5py", "pyfftw", "torch")


def environment(ranks: int) -> dict[str, object]:
    """Return the versions of this package and its libraries, the commit of the checkout, the kernels in use, the number
    of ranks and the date."""
    return {"eddies": eddies.__version__, "commit": commit(), "libraries": versions(), "kernels": in_use(),
            "ranks": ranks, "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")}


@functools.cache  # finding the versions reads long files of the installation
def versions() -> dict[str, str]:
    """Return the versions of Python, HDF5, MPI and the installed libraries."""
    found = {"python": platform.python_version(), "hdf5": h5py.version.hdf5_version,
             "mpi": MPI.Get_library_version().strip("\0 \n").split("\n")[0]}
    for library in LIBRARIES:
        try:
            found[library] = metadata.version(library)
        except metadata.PackageNotFoundError:
            continue
    return found


def commit() -> str | None:
    """Return the git commit of the checkout that this package runs from, or None. No process is started, because MPI
    may forbid it."""
    git = Path(eddies.__file__).parents[2] / ".git"
    try:
        head = (git / "HEAD").read_text().strip()
        if not head.startswith("ref: "):
            return head
        reference = head.removeprefix("ref: ")
        if (git / reference).exists():
            return (git / reference).read_text().strip()
        packed = (git / "packed-refs").read_text().splitlines()
    except OSError:
        return None
    return next((line.split()[0] for line in packed if line.endswith(f" {reference}")), None)


def product_ids(directory: Path, kinds: Iterable[str]) -> dict[str, str | None]:
    """Return the ids of the products of these kinds in a directory, by kind. A missing or unreadable product is left
    out. The value is None if a product has no id."""
    beside = {kind: product_provenance(directory / MAKER_OF[kind].file) for kind in kinds}
    return {kind: origin.get("id") for kind, origin in beside.items() if origin}


def product_provenance(path: str | Path) -> dict[str, Any]:
    """Return the provenance of a complete product of this format; empty if there is no such product."""
    return _read_sound(path, read_provenance)


def product_attributes(path: str | Path, group: str) -> dict[str, Any]:
    """Return the attributes of a group of a complete product of this format; empty if there is no such product."""
    return _read_sound(path, lambda file: {
        key: python_value(value) for key, value in file[group].attrs.items()})


def product_fingerprint(path: str | Path) -> str | None:
    """Return the scene's fingerprint in a complete product of this format; None if there is no such product."""
    return product_provenance(path).get("fingerprint")


def others_trained_on(origin: Mapping[str, Any]) -> list[str]:
    """Return the paths of the ground truths that a model was trained on; empty if the ground truth of the model's own
    run is among them. `origin` is the model's provenance."""
    truths = origin.get("truths", {})
    return [] if origin.get("made_from", {}).get("ground_truth") in truths.values() else list(truths)


def read_provenance(file: h5py.File) -> dict[str, Any]:
    """Return the scene's text, fingerprint, versions, number of ranks, date, id and `made_from` of an open product.
    Old products have no id.

    Raises ProductError if the provenance is damaged.
    """
    found = read_json(file, "provenance")
    whole = {"eddies", "commit", "libraries", "ranks", "date"} <= found.keys()
    if not whole or not isinstance(found.get("made_from", {}), dict):
        raise _damaged(file, "provenance")
    return found


def read_json(file: h5py.File, name: str) -> dict[str, Any]:
    """Return the dict that an attribute of an open product holds as JSON; ProductError if it holds none."""
    try:
        found = json.loads(file.attrs[name])
    except (KeyError, TypeError, ValueError, OSError):
        found = None
    if not isinstance(found, dict):
        raise _damaged(file, name)
    return found


def has_this_format(file: h5py.File) -> bool:
    """Return whether an open product has the format that this version reads."""
    return bool(np.array_equal(file.attrs.get("format", 1), FORMAT))


def _read_sound(path: str | Path, read: Callable[[h5py.File], dict[str, Any]]) -> dict[str, Any]:
    try:
        with open_to_read(path) as file:
            return read(file) if file.attrs.get("complete", False) and has_this_format(file) else {}
    except (OSError, ValueError, KeyError, TypeError, RuntimeError):  # ProductError is a RuntimeError
        return {}


def _damaged(file: h5py.File, name: str) -> ContentError:
    return ContentError(f"{file.filename}: its attribute {name} is missing or not valid, the file is damaged; make it "
                        "again")


def read_metrics(path: Path) -> dict[str, Any]:
    """Return the numbers of a report, by section. Raises ProductError if the file is damaged."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        found = None
    if not isinstance(found, dict):
        raise ProductError(f"{path}: is damaged; run `eddies report {path.parents[1]}` again")
    return found
