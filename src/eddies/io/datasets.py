"""Groups of stored arrays for programs: as an xarray Dataset whose values are read when they are asked for, or, without
xarray, as a dictionary of numpy arrays."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from eddies.io.errors import ProductError
from eddies.io.reading import open_to_read

try:
    import xarray
    from xarray.backends import BackendArray
    from xarray.core.indexing import (BasicIndexer, IndexingSupport, LazilyIndexedArray, OuterIndexer,
                                      explicit_indexing_adapter)
except ImportError:
    xarray = None

AXES = {"xyz": ["x", "y", "z"], "component": ["x", "y", "z"]}
EDGE = 2 * math.pi  # of the cube, in units of L


def open_group(path: Path, name: str) -> Any:
    """The arrays of a group of a product, by name: those of all its elements, the `value` of each, with their times.

    ProductError where there is no such group, or no such file.
    """
    with opened(path) as file:
        group = file.get(name)
        if not isinstance(group, h5py.Group):
            raise ProductError(f"{path}: holds no {name}; it holds: {', '.join(groups_in(file))}")
        elements = {key: item.get("value") if isinstance(item, h5py.Group) else item for key, item in group.items()}
        arrays = {key: item for key, item in elements.items() if isinstance(item, h5py.Dataset)}
        if xarray is None:
            return {key: array[()] for key, array in arrays.items()}
        return dataset_of(path, arrays, dict(group.attrs))


def groups_in(file: h5py.File) -> list[str]:
    """The groups with arrays of their own, or of their elements."""
    found = []

    def look(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Group) and any(isinstance(one, h5py.Dataset) for one in item.values()):
            if "value" not in item and not name.endswith("/box"):
                found.append(name)

    file.visititems(look)
    return found


def opened(path: Path) -> h5py.File:
    """A product, for one process; ProductError where there is none."""
    try:
        return open_to_read(path)
    except OSError as error:
        raise ProductError(f"{path}: cannot be opened ({error}); make it with the stage of this name") from None


def dataset_of(path: Path, arrays: Mapping[str, h5py.Dataset], attributes: Mapping[str, Any]) -> Any:
    """An xarray Dataset with the axes that the arrays name; times, ids, wavenumbers and points are its coordinates."""
    variables, coordinates = {}, {}
    for key, array in arrays.items():
        axes = array.attrs.get("axes", "").split()
        axes = axes if len(axes) == array.ndim else [f"{key}_{axis}" for axis in range(array.ndim)]
        words = {name: array.attrs[name] for name in ("units", "description") if name in array.attrs}
        own = axes == [key] or (key == "id" and axes == ["particle"])
        if own:
            coordinates[axes[0]] = (axes, array[()], words)
        else:
            found = xarray.Variable(axes, LazilyIndexedArray(StoredArray(path, array)), words)
            # A scalar has no components.
            scalar = "component" in axes and array.shape[axes.index("component")] == 1
            variables[key] = found.isel(component=0) if scalar else found
        for axis, size in zip(axes, array.shape):
            if axis in AXES and size == len(AXES[axis]):
                coordinates.setdefault(axis, ([axis], AXES[axis]))
            elif axis in ("x", "y", "z"):
                coordinates.setdefault(axis, ([axis], EDGE * np.arange(size) / size, {"units": "L"}))
    return xarray.Dataset(variables, coordinates, {name: plain(value) for name, value in attributes.items()})


def plain(value: Any) -> Any:
    """A number or text of an attribute as Python has it."""
    return value.item() if isinstance(value, np.generic) else value


if xarray is not None:
    class StoredArray(BackendArray):
        """An array of a file that is opened whenever a part of it is read."""

        def __init__(self, path: Path, array: h5py.Dataset) -> None:
            self.path, self.name, self.shape, self.dtype = path, array.name, array.shape, array.dtype

        def __getitem__(self, key: BasicIndexer | OuterIndexer) -> np.ndarray:
            return explicit_indexing_adapter(key, self.shape, IndexingSupport.OUTER_1VECTOR, self._read)

        def _read(self, key: tuple) -> np.ndarray:
            with opened(self.path) as file:
                # HDF5 reads indices that increase.
                vector = next((axis for axis, index in enumerate(key) if isinstance(index, np.ndarray)), None)
                if vector is None:
                    return np.asarray(file[self.name][key])
                wanted, back = np.unique(key[vector], return_inverse=True)
                values = file[self.name][(*key[:vector], wanted, *key[vector + 1:])]
                dropped = sum(isinstance(index, int | np.integer) for index in key[:vector])
                return np.take(values, back, axis=vector - dropped)
