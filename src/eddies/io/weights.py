"""Trained weights: plain tensors with a description. Nothing is pickled."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from eddies.io.hdf5 import ProductError, Table, create_product, in_files, open_product, read_table, write_table
from eddies.io.new_files import set_attributes
from eddies.io.provenance import read_json, read_provenance


@dataclass(frozen=True)
class StoredWeights:
    """The content of a file of trained weights: a description, the tensors and the tables, each by name, and the
    provenance of the file."""

    path: Path
    description: dict[str, Any]
    weights: dict[str, np.ndarray]
    tables: dict[str, Table]
    provenance: dict[str, Any]


def save_weights(comm: MPI.Comm, path: str | Path, kind: str, description: Mapping[str, Any],
                 tensors: Mapping[str, np.ndarray], provenance: Mapping[str, Any],
                 tables: Mapping[str, Mapping[str, np.ndarray]] | None = None) -> None:
    """Write rank 0's tensors, a description and small tables as one product of this `kind`; collective. The description
    holds only values that JSON can store.

    Raises ProductError on all ranks if the file cannot be written or a tensor is not finite.
    """
    def write() -> None:
        for name, tensor in tensors.items():
            if not np.isfinite(tensor).all():
                raise ProductError(f"{path}: tensor {name} is not finite, so nothing is written; lower learning_rate")
        with create_product(MPI.COMM_SELF, path, kind, {"ranks": comm.size, **provenance}) as file:
            set_attributes(file, {"description": json.dumps(dict(description))})
            write_table(file, "weights", Table(tensors, ""))
            for name, columns in (tables or {}).items():
                write_table(file, name, columns)

    in_files(comm, Path(path), write)


def load_weights(comm: MPI.Comm, path: str | Path, kind: str) -> StoredWeights:
    """Read what `save_weights` wrote, on all ranks; collective. Raises ProductError if the file cannot be used or a
    tensor is not finite."""
    with open_product(comm, path, kind) as file:
        tables = {name: read_table(file, name) for name in file if name != "weights"}
        stored = StoredWeights(Path(path), read_json(file, "description"), read_table(file, "weights"), tables,
                               read_provenance(file))
    for name, tensor in stored.weights.items():
        if not np.isfinite(tensor).all():
            raise ProductError(f"{path}: tensor {name} holds values that are not finite; train again")
    return stored
