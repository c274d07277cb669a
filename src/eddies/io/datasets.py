"""Groups of arrays of a run as xarray Datasets. Their frames are read when they are used."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from eddies.errors import UserError
from eddies.io.damage import naming_damage, open_to_read
from eddies.io.errors import ProductError
from eddies.io.new_files import python_value

try:
    import xarray
    from xarray.backends import BackendEntrypoint
except ImportError as error:
    raise UserError("the arrays of a run need xarray: install it, or eddies with the extra [xarray]") from error

LABELS = {"xyz": ["x", "y", "z"], "component": ["x", "y", "z"]}
EDGE = 2 * math.pi  # of the cube, in units of L


class Frames:
    """An array whose first axis counts frames. xarray reads the frames that it uses.

    Parameters
    ----------
    shape, dtype : those of the array.
    read : yields the frames with the given numbers. A function that can be pickled.
    """

    def __init__(self, shape: Sequence[int], dtype: np.dtype,
                 read: Callable[[Iterable[int]], Iterator[np.ndarray]]) -> None:
        self.shape, self.dtype, self.ndim, self._read = tuple(shape), dtype, len(shape), read

    def reshape(self, shape: Sequence[int]) -> Frames:
        """Return the same frames in another shape."""
        return Frames(shape, self.dtype, self._read)

    def __getitem__(self, key: tuple) -> np.ndarray:
        """Return the part of the array that numpy returns; `key` has an entry for each axis."""
        first, *rest = (part for part in key if part is not Ellipsis)
        frames = np.arange(self.shape[0])[first]
        if not frames.size:
            return np.empty((0, *self.shape[1:]), self.dtype)[(slice(None), *rest)]
        arrays = sum(isinstance(part, np.ndarray) for part in key)
        if arrays < 2 and frames.ndim < 2:  # one whole frame is in memory at a time
            parts = [frame[tuple(rest)] for frame in self._frames(np.atleast_1d(frames))]
            return np.stack(parts) if frames.ndim else parts[0]
        if isinstance(first, slice):  # several arrays, which numpy combines
            return np.stack([*self._frames(frames)])[(slice(None), *rest)]
        used, places = np.unique(frames, return_inverse=True)
        return np.stack([*self._frames(used)])[(places.reshape(frames.shape), *rest)]

    def __array_function__(self, *_: Any) -> Any:
        """Tell xarray to keep this object, and to index it when values are used; functions of numpy do not take it."""
        return NotImplemented

    def _frames(self, numbers: np.ndarray) -> Iterator[np.ndarray]:
        return (frame.reshape(self.shape[1:]) for frame in self._read(numbers.tolist()))


class AsGiven(BackendEntrypoint):
    """An engine of `xarray.open_dataset` that opens a Dataset: xarray then keeps the values that it has read."""

    def open_dataset(self, filename_or_obj: Any, *, drop_variables: Any = None) -> xarray.Dataset:
        return filename_or_obj


def open_group(path: Path, name: str) -> xarray.Dataset:
    """Return the arrays in the group `name` of a product. A column of a trajectory appears as its dataset `value`.

    Raises ProductError if there is no such group or file.
    """
    with open_to_read(path) as file, naming_damage(path):
        if name not in (names := groups_in(file)):
            raise ProductError(f"{path}: holds no {name or 'such group'}; it holds: {', '.join(names)}")
        arrays = {}
        for key, item in file[name].items():
            item = item.get("value") if isinstance(item, h5py.Group) else item
            if isinstance(item, h5py.Dataset):
                axes, units = (python_value(item.attrs.get(attribute, "")) for attribute in ("axes", "units"))
                in_frames = item.ndim > 1 and axes.startswith("time")
                arrays[key] = (Frames(item.shape, item.dtype, partial(_stored, path.absolute(), item.name))
                               if in_frames else item[()]), axes, units
        box = file["about"].attrs if "about" in file else {}  # the unit and the place of the box in those of the tracks
        return as_dataset(arrays, {key: python_value(value) for key, value in file[name].attrs.items()},
                          box.get("length_unit", 1.0), box.get("corner", np.zeros(3)))


def groups_in(file: h5py.File) -> list[str]:
    """Return the names of the groups that hold arrays, without the columns and boxes of trajectories."""
    names = []

    def look(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Group) and any(isinstance(one, h5py.Dataset) for one in item.values()):
            if "value" not in item and not name.endswith("/box"):
                names.append(name)

    file.visititems(look)
    return names


def as_dataset(arrays: Mapping[str, tuple[np.ndarray | Frames, str, str]],
               attributes: Mapping[str, Any], unit: float = 1.0,
               corner: Sequence[float] = (0.0, 0.0, 0.0)) -> xarray.Dataset:
    """Return a Dataset of arrays, each with the names of its axes and its units ("" if unknown). Times, ids,
    wavenumbers and points are coordinates. `unit` is the edge of the cube over 2 pi, and `corner` (3,) is where the
    origin of the coordinates is in it."""
    variables, coordinates = {}, {}
    for key, (array, axes, units) in arrays.items():
        names = axes.split()
        if len(names) != array.ndim:
            names = [f"{key}_{axis}" for axis in range(array.ndim)]
        if "component" in names and array.shape[names.index("component")] == 1:  # a scalar
            array = array.reshape([size for size, axis in zip(array.shape, names) if axis != "component"])
            names.remove("component")
        if names == [key] or (key == "id" and names == ["particle"]):
            coordinates[names[0]] = names, array, {"units": units} if units else {}
        else:
            variables[key] = names, array, {"units": units} if units else {}
        for axis, size in zip(names, array.shape):
            if axis in LABELS:
                coordinates.setdefault(axis, ([axis], LABELS[axis]))
            elif axis in ("x", "y", "z"):
                coordinates.setdefault(axis, ([axis], unit * EDGE * np.arange(size) / size - corner["xyz".index(axis)],
                                              {"units": "L"}))
    return xarray.open_dataset(xarray.Dataset(variables, coordinates, attributes), engine=AsGiven)


def _stored(path: Path, name: str, frames: Iterable[int]) -> Iterator[np.ndarray]:
    """Yield frames of the dataset `name` of a file."""
    with open_to_read(path) as file, naming_damage(path):
        for frame in frames:
            yield file[name][frame]
