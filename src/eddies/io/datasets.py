"""Groups of arrays for programs and notebooks. A group is an xarray Dataset, which reads values when they are used.
Without xarray it is a dictionary of numpy arrays."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from eddies.io.damage import open_to_read
from eddies.io.errors import ProductError
from eddies.io.quantities import dataset_attributes, python_value

try:
    import xarray
    from xarray.backends import BackendArray
    from xarray.core.indexing import (BasicIndexer, IndexingSupport, LazilyIndexedArray, OuterIndexer,
                                      explicit_indexing_adapter)
except ImportError:
    xarray, BackendArray = None, object

AXES = {"xyz": ["x", "y", "z"], "component": ["x", "y", "z"]}
EDGE = 2 * math.pi  # of the cube, in units of L


@dataclass(frozen=True, eq=False)
class Array(BackendArray):
    """An array of which xarray reads only the parts that are used."""

    shape: tuple[int, ...]
    dtype: np.dtype
    attrs: Mapping[str, Any]  # may hold units, axes and description
    read: Callable[[tuple], np.ndarray]  # returns the part with these indices; () stands for the whole array

    def __getitem__(self, key: BasicIndexer | OuterIndexer) -> np.ndarray:
        return explicit_indexing_adapter(key, self.shape, IndexingSupport.OUTER_1VECTOR, self.read)


def known_array(place: str, values: np.ndarray) -> Array:
    """Return an array whose values are in memory. Its attributes are those of the dataset `place` in rollout.h5."""
    return Array(values.shape, values.dtype, dataset_attributes("rollout", place), values.__getitem__)


def computed_array(place: str, shape: tuple[int, ...], dtype: np.dtype,
                   make: Callable[[Sequence[int]], Sequence[np.ndarray]]) -> Array:
    """Return an array whose frames are computed when they are used. The first axis counts the frames, and `make`
    returns the frames with the given indices. The attributes are those of the dataset `place` in rollout.h5."""
    def read(part: tuple) -> np.ndarray:
        first, *others = part or (slice(None),)
        frames = np.arange(shape[0])[first]
        made = [np.asarray(values[tuple(others)]) for values in make(np.atleast_1d(frames).tolist())]
        if not frames.ndim:
            return made[0]
        return np.stack(made) if made else np.zeros((0, *shape[1:]), dtype)

    return Array(shape, dtype, dataset_attributes("rollout", place), read)


def open_group(path: Path, name: str) -> Any:
    """Return the arrays in the group `name` of a product. A column of a trajectory appears as its dataset `value`.

    Raises ProductError if there is no such group or file.
    """
    def read(array: str, part: tuple) -> np.ndarray:
        with open_to_read(path) as file:
            return np.asarray(file[array][part])

    with open_to_read(path) as file:
        group = file.get(name)
        if not isinstance(group, h5py.Group):
            raise ProductError(f"{path}: holds no {name}; it holds: {', '.join(groups_in(file))}")
        columns = {key: item.get("value") if isinstance(item, h5py.Group) else item for key, item in group.items()}
        arrays = {key: Array(item.shape, item.dtype, {name: python_value(value) for name, value in item.attrs.items()},
                             partial(read, item.name))
                  for key, item in columns.items() if isinstance(item, h5py.Dataset)}
        attributes = {key: python_value(value) for key, value in group.attrs.items()}
    return as_dataset(arrays, attributes)


def groups_in(file: h5py.File) -> list[str]:
    """Return the names of the groups that hold arrays, without the columns and boxes of trajectories."""
    names = []

    def look(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Group) and any(isinstance(one, h5py.Dataset) for one in item.values()):
            if "value" not in item and not name.endswith("/box"):
                names.append(name)

    file.visititems(look)
    return names


def as_dataset(arrays: Mapping[str, Array], attributes: Mapping[str, Any]) -> Any:
    """Return an xarray Dataset with these arrays, or a dictionary of numpy arrays if xarray is not installed. In the
    Dataset, times, ids, wavenumbers and points are coordinates."""
    if xarray is None:
        return {key: array.read(()) for key, array in arrays.items()}
    variables, coordinates = {}, {}
    for key, array in arrays.items():
        axes = array.attrs.get("axes", "").split()
        axes = axes if len(axes) == array.ndim else [f"{key}_{axis}" for axis in range(array.ndim)]
        words = {name: array.attrs[name] for name in ("units", "description") if name in array.attrs}
        if axes == [key] or (key == "id" and axes == ["particle"]):
            coordinates[axes[0]] = (axes, array.read(()), words)
        else:
            variable = xarray.Variable(axes, LazilyIndexedArray(array), words)
            scalar = "component" in axes and array.shape[axes.index("component")] == 1
            variables[key] = variable.isel(component=0) if scalar else variable
        for axis, size in zip(axes, array.shape):
            if axis in AXES and size == len(AXES[axis]):
                coordinates.setdefault(axis, ([axis], AXES[axis]))
            elif axis in ("x", "y", "z"):
                coordinates.setdefault(axis, ([axis], EDGE * np.arange(size) / size, {"units": "L"}))
    return xarray.Dataset(variables, coordinates, attributes)
