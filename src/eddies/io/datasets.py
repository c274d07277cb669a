"""Groups of arrays for programs and notebooks. A group is an xarray Dataset, which reads values when they are used.
Without xarray it is a dictionary of numpy arrays."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from eddies.io.checksums import open_to_read
from eddies.io.errors import ProductError
from eddies.io.quantities import dataset_attributes, python_value

try:
    import xarray
    from xarray.backends import BackendArray
    from xarray.core.indexing import (BasicIndexer, IndexingSupport, LazilyIndexedArray, OuterIndexer,
                                      explicit_indexing_adapter)
except ImportError:
    xarray = None

AXES = {"xyz": ["x", "y", "z"], "component": ["x", "y", "z"]}
EDGE = 2 * math.pi  # of the cube, in units of L


@dataclass(frozen=True)
class ComputedArray:
    """An array that is not in a file. Its frames, along the first axis, are computed when they are used."""

    place: str  # the path that it would have in rollout.h5, which gives its units and description
    shape: tuple[int, ...]
    dtype: np.dtype
    make: Callable[[Sequence[int]], Sequence[np.ndarray]]  # returns the frames with these indices

    @classmethod
    def of(cls, place: str, values: np.ndarray) -> ComputedArray:
        """An array with known values."""
        return cls(place, values.shape, values.dtype, lambda frames: [values[frame] for frame in frames])

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return len(self.shape)

    @property
    def attrs(self) -> dict[str, str]:
        """Units, axes, description."""
        return dataset_attributes("rollout", self.place)

    def __getitem__(self, key: Any) -> np.ndarray:
        first, *others = (key if isinstance(key, tuple) else (key,)) or (slice(None),)
        frames = np.arange(self.shape[0])[first]
        made = [np.asarray(values[tuple(others)]) for values in self.make(np.atleast_1d(frames).tolist())]
        if not frames.ndim:
            return made[0]
        return np.stack(made) if made else np.zeros((0, *self.shape[1:]), self.dtype)


def open_group(path: Path, name: str) -> Any:
    """The arrays of a group of a product, by name. A column of a trajectory is represented by its dataset `value`.

    ProductError if there is no such group or file.
    """
    def read(array: str, key: tuple) -> np.ndarray:
        with open_to_read(path) as file:
            return np.asarray(file[array][key])

    with open_to_read(path) as file:
        group = file.get(name)
        if not isinstance(group, h5py.Group):
            raise ProductError(f"{path}: holds no {name}; it holds: {', '.join(groups_in(file))}")
        columns = {key: item.get("value") if isinstance(item, h5py.Group) else item for key, item in group.items()}
        arrays = {key: item for key, item in columns.items() if isinstance(item, h5py.Dataset)}
        if xarray is None:
            return {key: array[()] for key, array in arrays.items()}
        attributes = {key: python_value(value) for key, value in group.attrs.items()}
        return _dataset({key: (array, lambda part, array=array.name: read(array, part))
                         for key, array in arrays.items()}, attributes)


def computed_group(arrays: Mapping[str, ComputedArray]) -> Any:
    """Computed arrays by name, in the form in which `open_group` returns stored ones."""
    if xarray is None:
        return {key: array[:] for key, array in arrays.items()}
    return _dataset({key: (array, array.__getitem__) for key, array in arrays.items()}, {})


def groups_in(file: h5py.File) -> list[str]:
    """The names of the groups that hold arrays, without the columns and boxes of trajectories."""
    names = []

    def look(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Group) and any(isinstance(one, h5py.Dataset) for one in item.values()):
            if "value" not in item and not name.endswith("/box"):
                names.append(name)

    file.visititems(look)
    return names


def _dataset(arrays: Mapping[str, tuple[Any, Callable[[tuple], np.ndarray]]], attributes: Mapping[str, Any]) -> Any:
    """An xarray Dataset. `arrays` maps each name to an array and a function that reads a part of this array. Times,
    ids, wavenumbers and points become coordinates."""
    variables, coordinates = {}, {}
    for key, (array, read) in arrays.items():
        axes = array.attrs.get("axes", "").split()
        axes = axes if len(axes) == array.ndim else [f"{key}_{axis}" for axis in range(array.ndim)]
        words = {name: array.attrs[name] for name in ("units", "description") if name in array.attrs}
        if axes == [key] or (key == "id" and axes == ["particle"]):
            coordinates[axes[0]] = (axes, array[()], words)
        else:
            variable = xarray.Variable(axes, LazilyIndexedArray(LazyArray(array, read)), words)
            scalar = "component" in axes and array.shape[axes.index("component")] == 1
            variables[key] = variable.isel(component=0) if scalar else variable
        for axis, size in zip(axes, array.shape):
            if axis in AXES and size == len(AXES[axis]):
                coordinates.setdefault(axis, ([axis], AXES[axis]))
            elif axis in ("x", "y", "z"):
                coordinates.setdefault(axis, ([axis], EDGE * np.arange(size) / size, {"units": "L"}))
    return xarray.Dataset(variables, coordinates, attributes)


if xarray is not None:
    class LazyArray(BackendArray):
        """An array of which xarray reads only the parts that are used."""

        def __init__(self, array: h5py.Dataset | ComputedArray, read: Callable[[tuple], np.ndarray]) -> None:
            self.shape, self.dtype, self._read = array.shape, array.dtype, read

        def __getitem__(self, key: BasicIndexer | OuterIndexer) -> np.ndarray:
            return explicit_indexing_adapter(key, self.shape, IndexingSupport.OUTER_1VECTOR, self._read)
