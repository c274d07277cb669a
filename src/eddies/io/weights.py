"""Trained weights: plain tensors with a description. Nothing is pickled."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from eddies.io.hdf5 import ProductError, create_product, in_files, open_product, read_table, write_table
from eddies.io.provenance import read_json


def save_weights(comm: MPI.Comm, path: str | Path, kind: str, description: Mapping[str, Any],
                 tensors: Mapping[str, np.ndarray], provenance: Mapping[str, Any],
                 tables: Mapping[str, Mapping[str, np.ndarray]] | None = None) -> None:
    """Write rank 0's tensors, a JSON-able description and small tables as one product; collective.

    Raises ProductError on all ranks if the file cannot be written or a tensor is not finite.
    """
    def write() -> None:
        for name, tensor in tensors.items():
            if not np.isfinite(tensor).all():
                raise ProductError(f"{path}: tensor {name} is not finite, so nothing is written; lower learning_rate")
        with create_product(MPI.COMM_SELF, path, kind, {"ranks": comm.size, **provenance}) as file:
            file.attrs["description"] = json.dumps(dict(description))
            write_table(file, "weights", tensors)
            for name, columns in (tables or {}).items():
                write_table(file, name, columns)

    in_files(comm, Path(path), write)


def load_weights(comm: MPI.Comm, path: str | Path, kind: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Description and tensors of a product, on all ranks; collective. ProductError also if a tensor is not finite."""
    with open_product(comm, path, kind) as file:
        description, tensors = read_json(file, "description"), read_table(file, "weights")
    for name, tensor in tensors.items():
        if not np.isfinite(tensor).all():
            raise ProductError(f"{path}: tensor {name} holds values that are not finite; train again")
    return description, tensors


def load_tables(comm: MPI.Comm, path: str | Path) -> dict[str, dict[str, np.ndarray]]:
    """The tables saved with the weights, by name, on all ranks; collective."""
    with open_product(comm, path, None) as file:
        return {name: read_table(file, name) for name in file if name != "weights"}
