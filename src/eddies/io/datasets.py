"""Groups of stored arrays for programs: as an xarray Dataset whose values are read when they are asked for, or, without
xarray, as a dictionary of numpy arrays."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from eddies.io.errors import ProductError
from eddies.io.quantities import words_on
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


@dataclass(frozen=True)
class MadeArray:
    """An array that no file holds: what is asked of it is made then, frame by frame along its first axis.

    Parameters
    ----------
    place : where a rollout.h5 would have it, which says what it is.
    shape, dtype : of the whole.
    make : what it is at frames, one array each.
    """

    place: str
    shape: tuple[int, ...]
    dtype: np.dtype
    make: Callable[[Sequence[int]], Sequence[np.ndarray]]

    @classmethod
    def of(cls, place: str, values: np.ndarray) -> MadeArray:
        """Of values that are known."""
        return cls(place, values.shape, values.dtype, lambda frames: [values[frame] for frame in frames])

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return len(self.shape)

    @property
    def attrs(self) -> dict[str, str]:
        """Units, axes, description."""
        return words_on("rollout", self.place)

    def __getitem__(self, key: Any) -> np.ndarray:
        first, *others = (key if isinstance(key, tuple) else (key,)) or (slice(None),)
        frames = np.arange(self.shape[0])[first]
        made = [np.asarray(values[tuple(others)]) for values in self.make(np.atleast_1d(frames).tolist())]
        if not frames.ndim:
            return made[0]
        return np.stack(made) if made else np.zeros((0, *self.shape[1:]), self.dtype)


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
        return dataset_of({key: (array, StoredArray(path, array)) for key, array in arrays.items()}, dict(group.attrs))


def made_group(arrays: Mapping[str, MadeArray]) -> Any:
    """Arrays that are made when they are asked for, as those of a group that is stored."""
    if xarray is None:
        return {key: array[:] for key, array in arrays.items()}
    return dataset_of({key: (array, LazyArray(array)) for key, array in arrays.items()}, {})


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


def dataset_of(arrays: Mapping[str, tuple[Any, Any]], attributes: Mapping[str, Any]) -> Any:
    """An xarray Dataset with the axes that the arrays name, each with what reads it when it is used; times, ids,
    wavenumbers and points are its coordinates."""
    variables, coordinates = {}, {}
    for key, (array, lazy) in arrays.items():
        axes = array.attrs.get("axes", "").split()
        axes = axes if len(axes) == array.ndim else [f"{key}_{axis}" for axis in range(array.ndim)]
        words = {name: array.attrs[name] for name in ("units", "description") if name in array.attrs}
        own = axes == [key] or (key == "id" and axes == ["particle"])
        if own:
            coordinates[axes[0]] = (axes, array[()], words)
        else:
            found = xarray.Variable(axes, LazilyIndexedArray(lazy), words)
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

    class LazyArray(BackendArray):
        """A made array."""

        def __init__(self, array: MadeArray) -> None:
            self.array, self.shape, self.dtype = array, array.shape, array.dtype

        def __getitem__(self, key: BasicIndexer | OuterIndexer) -> np.ndarray:
            return explicit_indexing_adapter(key, self.shape, IndexingSupport.BASIC, self.array.__getitem__)
