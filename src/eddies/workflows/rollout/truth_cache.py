"""What has been measured of the true particles of a ground truth, kept beside it for the next report or variant."""

from __future__ import annotations

import functools
import hashlib
import json
import logging
import os
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import eddies
from eddies.analysis.rollout import Reconstruction
from eddies.analysis.velocity_gradients import Invariants
from eddies.errors import UserError
from eddies.io.hdf5 import create_product, open_product, read_attributes, read_table, write_attributes, write_table
from eddies.io.provenance import product_provenance
from eddies.kernels.library import in_use
from eddies.parallel.communicator import Comm

log = logging.getLogger("eddies")

KIND = "truth_measures"
#: By quantity, "spectra" or "reconstructions", and frame of the ground truth.
Measures = dict[tuple[str, int], Any]
Table = Mapping[str, np.ndarray]
TABLE = "{}_of_truth"
COLUMNS = {"spectra": ("frame", "energy"),
           "reconstructions": ("frame", "second", "third", "scale", "velocity", "vorticity")}


class TruthCache:
    """The file truth_measures.h5 beside the ground truth that `truth` is or is linked to, with a table a quantity.

    A table holds for one ground truth and, of reconstructions, one kernel, each known by its id, size and time of
    writing, and for one state of the code: its mark. A table of others, or a damaged one, counts for nothing. That the
    file cannot be written costs no more than to measure again.

    Parameters
    ----------
    truth : path of the ground truth. kernel : that of the kernel, or None. alone : a communicator of one rank.
    """

    def __init__(self, truth: Path, kernel: Path | None, alone: Comm) -> None:
        self.path, self.alone = truth.resolve().with_name(f"{KIND}.h5"), alone
        self._keys = {"spectra": json.dumps([_code(), in_use(), _identity(truth)])}
        if kernel is not None:
            self._keys["reconstructions"] = json.dumps([_code(), in_use(), _identity(truth), _identity(kernel)])

    def read(self) -> Measures:
        """All that is known; empty where nothing is, or where it is of no use."""
        tables, marks = self._stored(self.path)
        found: Measures = {}
        for quantity, key in self._keys.items():
            if quantity in tables and marks.get(quantity) == key:
                for frame, *values in zip(*(tables[quantity][column] for column in COLUMNS[quantity])):
                    found[quantity, int(frame)] = values[0] if quantity == "spectra" else Reconstruction(
                        Invariants(*values[:2], float(values[2])), *values[3:])
        return found

    def write(self, measures: Measures) -> None:
        """Put these measures in the place of those of the same quantities."""
        tables, marks = self._stored(self.path)
        for quantity in {quantity for quantity, _ in measures}:
            rows = [(frame, *_values(found)) for (kind, frame), found in sorted(measures.items(), key=_place)
                    if kind == quantity]
            tables[quantity] = dict(zip(COLUMNS[quantity], map(np.array, zip(*rows))))
            marks[quantity] = self._keys[quantity]
        scratch = self.path.with_name(f"{KIND}-{uuid.uuid4().hex}.h5")  # others may write at the same time
        try:
            try:
                with create_product(self.alone, scratch, KIND, {}) as file:
                    for quantity, table in tables.items():
                        write_table(file, TABLE.format(quantity), table)
                    write_attributes(file.create_group("marks"), marks)
                os.replace(scratch, self.path)
            finally:
                scratch.unlink(missing_ok=True)
        except (UserError, OSError, KeyError) as error:
            log.debug("%s: not written: %s", self.path, error)

    def _stored(self, path: Path) -> tuple[dict[str, Table], dict[str, str]]:
        """The tables of a file and their marks; none where it cannot be read."""
        if not path.is_file():
            return {}, {}
        try:
            with open_product(self.alone, path, KIND) as file:
                tables = {quantity: read_table(file, TABLE.format(quantity)) for quantity in COLUMNS
                          if TABLE.format(quantity) in file}
                return tables, read_attributes(file, "marks")
        except (UserError, OSError, KeyError, ValueError, RuntimeError) as error:
            log.debug("%s: cannot be used: %s", path, error)
            return {}, {}


def _place(item: tuple[tuple[str, int], Any]) -> tuple[str, int]:
    return item[0]


def _values(found: np.ndarray | Reconstruction) -> tuple:
    """The columns of one measure, after its frame."""
    if not isinstance(found, Reconstruction):
        return (found,)
    invariants = found.invariants
    return (invariants.second, invariants.third, invariants.scale, found.velocity, found.vorticity)


@functools.cache
def _code() -> str:
    """A hash of the sources of the package, committed or not."""
    found, package = hashlib.blake2b(digest_size=16), Path(eddies.__file__).parent
    for path in sorted([*package.rglob("*.py"), *package.rglob("*.?pp")]):
        found.update(path.read_bytes())
    return found.hexdigest()


def _identity(path: Path) -> list[Any]:
    """What tells a product from others, and from itself if somebody changes it."""
    state = path.stat()
    return [product_provenance(path).get("id"), state.st_size, state.st_mtime_ns]
