"""VTKHDF files: a series of fields or of particles in one file that ParaView opens.

The layout is version 2.0 of the "VTKHDF file format" in the documentation of VTK. VTK 9.3 (ParaView 5.12) and later
versions read it. A file needs no other file. The reader fails on a time axis with one step. A single frame is therefore
written without steps; its time is the field data `time`.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from eddies.io.fields import FieldSeries
from eddies.io.new_files import Layout, create_export
from eddies.io.trajectories import Trajectory

VERSION = (2, 0)
BLOCK_BYTES = 2**26  # the most bytes of a field that are in memory at once
STEP_BYTES = 2**10  # upper limit of the bytes of a step outside the large datasets


def write_images(path: Path, series: FieldSeries, length: float, corner: np.ndarray,
                 provenance: Mapping[str, Any]) -> None:
    """Write a series of fields in a cube of edge `length` as ImageData, a step for each frame; on one rank.

    The first point is at `corner` (3,). The values are point data. The plane at `length`, equal to that at 0, is
    added along each axis, so that the (cells + 1)^3 points span the whole cube. ProductError if the file cannot be
    written.
    """
    cells, frames, layout = series.cells, len(series.times), {}
    for variable in series.variables:
        sample = series.read(0, variable, 0, 0)
        components = sample.shape[:1] if len(sample) > 1 else ()
        shape = (*[cells + 1] * 3, *components)
        layout[f"PointData/{variable}"] = shape if frames == 1 else (frames, *shape), sample.dtype
    with _create(path, "ImageData", frames, layout, provenance) as root:
        root.attrs.update({"WholeExtent": np.array([0, cells] * 3), "Origin": corner,
                           "Spacing": np.full(3, length / cells), "Direction": np.eye(3).ravel()})
        _write_steps(root, series.times, {_offsets_of(name): np.arange(frames) for name in layout})
        for variable in series.variables:
            for frame in range(frames):
                _copy_field(series, frame, variable, root[f"PointData/{variable}"])


def write_points(path: Path, trajectory: Trajectory, provenance: Mapping[str, Any]) -> None:
    """Write trajectories as PolyData, a step for each frame and a vertex for each particle; on one rank.

    Point data are the particle's `id` and all columns except the position; a 3 x 3 column has 9 components, row by row.
    ProductError if the file cannot be written.
    """
    frames, total, layout = len(trajectory.times), trajectory.total, {}
    names = {column: "Points" if column == "position" else f"PointData/{column}" for column in trajectory.columns}
    for column, name in names.items():
        sample = trajectory.read(0, column, 0, 0)
        components = (math.prod(sample.shape[1:]),) if sample.ndim > 1 else ()
        layout[name] = (frames * total, *components), sample.dtype
    counted = {"PointData/id": total, "Vertices/Connectivity": total, "Vertices/Offsets": total + 1}
    layout |= {name: ((count,), np.int64) for name, count in counted.items()}
    with _create(path, "PolyData", frames, layout, provenance) as root:
        for name, count in counted.items():
            root[name][:] = np.arange(count)
        _write_cells(root, total)
        _write_steps(root, trajectory.times, _point_offsets(frames, total, names.values()))
        for column, name in names.items():
            for frame in range(frames):
                values = trajectory.read(frame, column).reshape(total, *root[name].shape[1:])
                root[name][frame * total:(frame + 1) * total] = values


@contextmanager
def _create(path: Path, kind: str, frames: int, layout: Layout,
            provenance: Mapping[str, Any]) -> Iterator[h5py.Group]:
    """Create a file and yield its group VTKHDF, which has the empty datasets of `layout`. `kind` is VTK's name for the
    type of the data, and `frames` is the number of frames."""
    within = {f"VTKHDF/{name}": dataset for name, dataset in layout.items()}
    with create_export(path, within, provenance, STEP_BYTES * frames) as file:
        root = file["VTKHDF"]
        # The reader needs the type as a string of fixed length.
        root.attrs.update({"Version": np.array(VERSION), "Type": np.bytes_(kind)})
        yield root


def _write_steps(root: h5py.Group, times: np.ndarray, offsets: Mapping[str, np.ndarray]) -> None:
    """Write the times of the steps, and each step's offset in each dataset. A single time is written as field data."""
    if len(times) == 1:
        root["FieldData/time"] = times
        return
    steps = root.create_group("Steps")
    steps.attrs["NSteps"] = len(times)
    for name, values in {"Values": times, **offsets}.items():
        steps[name] = values


def _copy_field(series: FieldSeries, frame: int, variable: str, dataset: h5py.Dataset) -> None:
    """Copy a field (components, z, y, x) to a dataset (z, y, x, components); the last plane of each axis repeats the
    first."""
    cells, frames = series.cells, len(series.times)
    step = () if frames == 1 else (frame,)
    blocks = math.ceil(dataset.nbytes / frames / BLOCK_BYTES)
    for planes in np.array_split(np.arange(cells), min(blocks, cells)):
        start, stop = planes[0], planes[-1] + 1
        block = np.moveaxis(series.read(frame, variable, start, stop), 0, -1)
        block = np.pad(block, ((0, 0), (0, 1), (0, 1), (0, 0)), mode="wrap")
        block = block.reshape(stop - start, *dataset.shape[len(step) + 1:])
        dataset[*step, start:stop] = block
        if start == 0:
            dataset[*step, cells] = block[0]


def _write_cells(root: h5py.Group, total: int) -> None:
    """Write the numbers of points and of cells. Each of the `total` points has a vertex; there are no lines, polygons
    or strips."""
    root["NumberOfPoints"] = np.array([total])
    for cells, count in (("Vertices", total), ("Lines", 0), ("Polygons", 0), ("Strips", 0)):
        root[f"{cells}/NumberOfCells"] = root[f"{cells}/NumberOfConnectivityIds"] = np.array([count])
        if not count:
            root[f"{cells}/Connectivity"], root[f"{cells}/Offsets"] = np.zeros(0, np.int64), np.zeros(1, np.int64)


def _point_offsets(frames: int, total: int, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Return the offsets of the steps in each dataset. The datasets `names` hold `total` rows for each step. All steps
    share the ids and the cells, which are stored once."""
    shared = np.zeros(frames, np.int64)
    offsets = {"NumberOfParts": shared + 1, "PartOffsets": shared, "PointDataOffsets/id": shared}
    for name in ("CellOffsets", "ConnectivityIdOffsets"):
        offsets[name] = np.zeros((frames, 4), np.int64)  # of the four kinds of cells
    for name in names:
        offsets[_offsets_of(name)] = total * np.arange(frames)
    return offsets


def _offsets_of(name: str) -> str:
    """Return the name under which the group Steps stores the offsets of the dataset `name`."""
    return "PointOffsets" if name == "Points" else name.replace("PointData/", "PointDataOffsets/")
