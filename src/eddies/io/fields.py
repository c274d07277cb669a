"""Series of fields on a regular grid, written slab by slab."""

from collections.abc import Mapping
from functools import cached_property

import h5py
import numpy as np

from eddies.io.hdf5 import append_frame, find_group, growing_dataset, read_frame, read_times, unfit
from eddies.io.units import component_axis, unit_of


class FieldWriter:
    """Adds fields on cells^3 points to /fields/NAME in float32. The constructor and `append` are collective.

    Parameters
    ----------
    file : an open product.
    name : the group under /fields.
    cells : grid points along each side; point i is at i * edge / cells.
    variables : number of components of each variable, such as {"velocity": 3, "density": 1}.
    """

    def __init__(self, file: h5py.File, name: str, cells: int, variables: Mapping[str, int]) -> None:
        group = file.create_group(f"fields/{name}")
        group.attrs["cells"] = cells
        self._time = growing_dataset(group, "time", (), np.float64, "time", "T")
        self._variables = {variable: growing_dataset(
            group, variable, (components, *[cells] * 3), np.float32,
            f"time {component_axis(variable, components, 'component')} z y x", unit_of(variable))
            for variable, components in variables.items()}

    def append(self, time: float, start_plane: int, variables: Mapping[str, np.ndarray]) -> None:
        """Add a frame. `variables` holds this rank's planes start_plane, start_plane + 1, ... of each variable,
        (components, planes, y, x), or no plane."""
        append_frame(self._time, np.array(time), ())
        for variable, dataset in self._variables.items():
            append_frame(dataset, variables[variable], (0, start_plane, 0, 0))


class FieldSeries:
    """Reads /fields/NAME of an open product; ProductError if it is missing or malformed."""

    def __init__(self, file: h5py.File, name: str) -> None:
        self.file, self._group = file, find_group(file, f"fields/{name}")
        self.cells = int(self._group.attrs["cells"])  # grid points along each side
        self.variables = tuple(variable for variable in self._group if variable != "time")

    def __len__(self) -> int:
        return len(self.times)

    @cached_property
    def times(self) -> np.ndarray:
        """Time of each field, (frames,)."""
        times = read_times(self._group["time"])
        for dataset in (self._group[name] for name in self.variables):
            if (dataset.shape[0], *dataset.shape[2:]) != (len(times), *[self.cells] * 3):
                raise unfit(dataset, f"has the shape {dataset.shape}; expected {len(times)} times, {self.cells} cells")
        return times

    def read(self, index: int, variable: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Return planes start, ..., stop - 1 of a variable, (components, stop - start, y, x). Raises ProductError
        as `read_frame` does."""
        return read_frame(self._group[variable], index, (slice(None), slice(start, stop)))
