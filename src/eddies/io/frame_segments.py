"""Segments are files with frames. A segment is closed at each checkpoint, so that a later failure cannot damage it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mpi4py import MPI

from eddies.io.fields import FieldSeries, FieldWriter
from eddies.io.hdf5 import File, create_product, in_files, open_product
from eddies.io.trajectories import Trajectory, TrajectoryWriter
from eddies.parallel.migration import id_block
from eddies.parallel.slab import SlabDecomposition


@dataclass(frozen=True)
class FieldLayout:
    """The content of a series of fields."""

    cells: int  # grid points along each side
    variables: Mapping[str, int]  # number of components of each variable


@dataclass(frozen=True)
class TrajectoryLayout:
    """The content of a trajectory, a series of frames of particles."""

    total: int  # number of particles
    columns: Mapping[str, tuple[int, ...]]  # shape of one particle's value in each column


@dataclass(frozen=True)
class FrameLayout:
    """The series of frames in a segment or product: trajectories and fields. Series may have different times."""

    length: float  # edge of the periodic cube
    trajectories: Mapping[str, TrajectoryLayout]  # by name
    dtype: type[np.floating]  # of the trajectories
    fields: Mapping[str, FieldLayout]  # by name

    def writers(self, file: File, names: Mapping[str, str] | None = None, images: bool = False
                ) -> tuple[dict[str, TrajectoryWriter], dict[str, FieldWriter]]:
        """Return the writers of trajectories and those of fields, as two dicts by name of the series; collective.

        The keys of `names` are the series to be written, and its values are their names in the file. If it is None, all
        series are written under their own names. `images` adds the column `image` to trajectories with positions.
        """
        if names is None:
            names = {name: name for name in (*self.trajectories, *self.fields)}
        return ({name: TrajectoryWriter(file, names[name], series.total, self.length, series.columns, self.dtype,
                                        images and "position" in series.columns)
                 for name, series in self.trajectories.items() if name in names},
                {name: FieldWriter(file, names[name], series.cells, series.variables)
                 for name, series in self.fields.items() if name in names})


class FrameSegments:
    """The files frames-NNNNNNNN.h5 of a directory, named after their first step; `names` lists the closed files.
    The first closed file may be a product with the same series.

    If the `with` block ends with an exception, the open segment is removed. `assemble` copies frames into a product.
    """

    def __init__(self, comm: MPI.Comm, directory: Path, layout: FrameLayout, names: Sequence[str] = ()) -> None:
        self.comm, self.directory, self.layout, self.names = comm, directory, layout, list(names)
        self._name, self._file = "", ExitStack()

    def open(self, step: int) -> None:
        """Begin a segment, unless one is open. The attributes `trajectories` and `fields` hold its writers by name."""
        if self._name:
            return
        in_files(self.comm, self.directory, lambda: self.directory.mkdir(exist_ok=True))
        self._name = f"frames-{step:08d}.h5"
        file = self._file.enter_context(create_product(self.comm, self.directory / self._name, "frames", {}))
        self.trajectories, self.fields = self.layout.writers(file)

    def close(self) -> None:
        """Close the open segment, if any."""
        if self._name:
            self._file.close()
            self.names.append(self._name)
            self._name = ""

    def first_frames(self, name: str, count: int) -> list[tuple[float, dict[str, np.ndarray]]]:
        """Return the times and columns of the first `count` frames of the trajectory `name` in closed segments. The
        columns hold only this rank's rows."""
        frames: list[tuple[float, dict[str, np.ndarray]]] = []
        for segment in self.names[:count]:  # each segment holds one frame or more
            with open_product(self.comm, self.directory / segment, None) as file:
                stored = Trajectory(file, name)
                frames += [(time, self._values(stored, frame)) for frame, time in enumerate(stored.times[:count])]
        return frames[:count]

    def assemble(self, file: File, names: Mapping[str, str] | None = None) -> None:
        """Copy the frames of all segments into a product, and add the column `image`. `names` selects the series as in
        `FrameLayout.writers`."""
        self.close()
        trajectories, fields = self.layout.writers(file, names, images=True)
        for name in self.names:
            with open_product(self.comm, self.directory / name, None) as segment:
                for group, trajectory in trajectories.items():
                    frames = Trajectory(segment, group)
                    start, _ = id_block(self.comm, frames.total)
                    for frame, (step, time) in enumerate(zip(frames.steps, frames.times)):
                        trajectory.append(step, time, start, self._values(frames, frame))
                for group, field in fields.items():
                    series = FieldSeries(segment, group)
                    slab = SlabDecomposition(self.comm, self.layout.length, series.cells)
                    for index, time in enumerate(series.times):
                        field.append(time, slab.start, {variable: series.read(index, variable, slab.start, slab.stop)
                                                        for variable in series.variables})

    def __enter__(self) -> FrameSegments:
        return self

    def __exit__(self, *raised) -> None:
        self._file.__exit__(*raised)

    def _values(self, frames: Trajectory, frame: int) -> dict[str, np.ndarray]:
        """Return this rank's rows of all columns of a frame, by name of the column."""
        block = id_block(self.comm, frames.total)
        return {column: frames.read(frame, column, *block) for column in frames.columns}
