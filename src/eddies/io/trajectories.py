"""Particle trajectories in the H5MD 1.1 layout (de Buyl, Colberg & Höfling, Comput. Phys. Commun. 185, 1546).

Row k of every frame belongs to the particle with id k, so frames can be compared without sorting. The edges of the
box are stored for every frame. The attribute `unit` names molecular units (Angstrom, ps) in place of L, T and L/T,
because readers such as MDAnalysis accept no others.
"""

from collections.abc import Mapping
from functools import cached_property

import h5py
import numpy as np

import eddies
from eddies.io.hdf5 import append_frame, find_group, growing_dataset, read_frame, read_times, unfit, write_array
from eddies.io.units import UNITS, component_axis, unit_of

IMAGE = "image"
MOLECULAR = {"position": "Angstrom", "box/edges": "Angstrom", "velocity": "Angstrom ps-1"}
ROUNDING = 1e-6  # relative rounding error of positions in single precision


class TrajectoryWriter:
    """Adds frames of `total` particles to /particles/NAME. The constructor and every `append` are collective.

    Parameters
    ----------
    file : an open product.
    name : the group under /particles.
    total : number of particles over all ranks.
    length : edge of the periodic cube.
    columns : shape of one particle's value by column, such as {"position": (3,), "density": ()}.
    dtype : type of every column in the file.
    images : whether to add the column `image` (3,). It counts how often a particle has left the cube along each axis
        since the first frame, so that position + edge * image is a continuous path. Particles must move by less than
        half an edge between frames, and a rank must hold the same rows in every `append`.
    """

    def __init__(self, file: h5py.File, name: str, total: int, length: float,
                 columns: Mapping[str, tuple[int, ...]], dtype: str | np.dtype, images: bool = False) -> None:
        write_h5md_header(file)
        self._group = file.create_group(f"particles/{name}")
        box = self._group.create_group("box")
        box.attrs.update({"edge": length, "dimension": 3, "boundary": np.array([b"periodic"] * 3)})
        write_array(self._group, "id", np.arange(total), "particle")
        self._step = growing_dataset(self._group, "step", (), np.int64, "time")
        self._time = growing_dataset(self._group, "time", (), np.float64, "time", "T")
        self._time.attrs["unit"] = "ps"
        self._edges = self._element("box/edges", (3, 3), np.float64, "time i j", UNITS["position"])
        self._columns = {column: self._column(column, total, shape, dtype) for column, shape in columns.items()}
        self._length, self._images = length, images
        self._before: np.ndarray | None = None
        self._image: np.ndarray | int = 0
        if images:
            self._columns[IMAGE] = self._column(IMAGE, total, (3,), np.int16)

    def append(self, step: int, time: float, start: int, columns: Mapping[str, np.ndarray]) -> None:
        """Add a frame. `columns` holds this rank's rows start, start + 1, ... of every column by name, or no row."""
        append_frame(self._step, np.array(step), ())
        append_frame(self._time, np.array(time), ())
        append_frame(self._edges, np.diag([self._length] * 3), (0, 0))
        if self._images:
            columns = {**columns, IMAGE: self._count_images(columns["position"])}
        for column, dataset in self._columns.items():
            append_frame(dataset, columns[column], (start,) + (0,) * (dataset.ndim - 2))

    def _column(self, column: str, total: int, shape: tuple[int, ...], dtype: str | np.dtype) -> h5py.Dataset:
        axes = ["time", "particle", *(component_axis(column, size, "xyz") for size in shape)]
        return self._element(column, (total, *shape), dtype, " ".join(axes), unit_of(column))

    def _element(self, column: str, frame_shape: tuple[int, ...], dtype: str | np.dtype, axes: str,
                 units: str) -> h5py.Dataset:
        element = self._group.create_group(column)
        # Hard links: all columns share the steps and times.
        element["step"], element["time"] = self._step, self._time
        values = growing_dataset(element, "value", frame_shape, dtype, axes, units)
        if column in MOLECULAR:
            values.attrs["unit"] = MOLECULAR[column]
        return values

    def _count_images(self, position: np.ndarray) -> np.ndarray:
        """Return the column `image` (n, 3) of this rank's particles in the next frame, from their wrapped positions."""
        left = np.zeros_like(position) if self._before is None else np.rint((self._before - position) / self._length)
        # A rollout may end with positions that are not finite.
        self._image = self._image + np.nan_to_num(left, posinf=0, neginf=0).astype(np.int16)
        self._before = position
        return self._image


class Trajectory:
    """Reads /particles/NAME of an open product; ProductError if it is missing or malformed."""

    def __init__(self, file: h5py.File, name: str) -> None:
        self._group = group = find_group(file, f"particles/{name}")
        self.total = group["id"].shape[0]  # number of particles
        box = group["box"]
        # Edge of the periodic cube. Files of eddies 1.0 have one set of edges for all frames.
        self.length = float(box.attrs["edge"] if "edge" in box.attrs else box["edges"][0])
        self._ids = group["id"]
        self._values = {column: group[f"{column}/value"] for column in group if f"{column}/value" in group}
        self.columns = tuple(self._values)
        self._in_order: set[tuple[int, int | None]] = set()  # rows whose ids have been checked

    @cached_property
    def times(self) -> np.ndarray:
        """Time of each frame, (frames,)."""
        times = read_times(self._group["time"])
        for dataset in self._values.values():
            if dataset.shape[:2] != (len(times), self.total):
                raise unfit(dataset, f"holds {dataset.shape[:2]} frames and particles, but there are "
                                     f"{(len(times), self.total)} times and ids")
        return times

    @cached_property
    def steps(self) -> np.ndarray:
        """Step number of each frame, (frames,)."""
        return self._group["step"][()]

    def read(self, frame: int, column: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Return rows start, ..., stop - 1 of a column at a frame, (stop - start, ...), in order of id.

        Raises ProductError if ids are not in order, a position is outside the cube or, except in a rollout, a number
        is not finite.
        """
        rows = slice(start, stop)
        if (start, stop) not in self._in_order:
            if not np.array_equal(self._ids[rows], np.arange(*rows.indices(self.total))):
                raise unfit(self._ids, "holds ids that are not in order")
            self._in_order.add((start, stop))
        limit = self.length * (1 + ROUNDING) if column == "position" else np.inf
        dataset = self._values[column] if column in self._values else find_group(self._group, column)["value"]
        return read_frame(dataset, frame, (rows,), limit)


def write_h5md_header(file: h5py.File) -> None:
    """Write the group /h5md, unless it exists."""
    if "h5md" in file:
        return
    header = file.create_group("h5md")
    header.attrs["version"] = np.array([1, 1])
    header.create_group("author").attrs["name"] = "unknown"
    header.create_group("creator").attrs.update({"name": "eddies", "version": eddies.__version__})
