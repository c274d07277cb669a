"""Frames of tracers in segments: files that are closed at each checkpoint, so that no later accident harms them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from eddies.io.fields import FieldSeries, FieldWriter
from eddies.io.hdf5 import File, create_product, in_files, open_product
from eddies.io.trajectories import Trajectory, TrajectoryWriter
from eddies.parallel.communicator import Comm
from eddies.parallel.migration import id_block
from eddies.parallel.slab import SlabDecomposition
from eddies.scene.scene import BOX_LENGTH, Tracers
from eddies.workflows.ground_truth.measured_scales import measured_scales


class FrameSegments:
    """The files frames-NNNNNNNN.h5 of a directory, named after their first step; `names` are those that are closed.

    A context manager: leaving it by an exception leaves the open segment unfinished. Trajectories and fields have
    the same layout as in the ground truth, into which `assemble` copies all frames at the end.
    """

    def __init__(self, comm: Comm, directory: Path, settings: Tracers, compressible: bool,
                 names: Sequence[str] = ()) -> None:
        self.comm, self.directory, self.settings, self.names = comm, directory, settings, list(names)
        self.scalar = {"density": ()} if compressible else {}
        self._name, self._file = "", ExitStack()

    def open(self, step: int) -> None:
        """Begin a segment, unless one is open: `trajectory` and `fields` take its frames."""
        if self._name:
            return
        in_files(self.comm, self.directory, lambda: self.directory.mkdir(exist_ok=True))
        self._name = f"frames-{step:08d}.h5"
        file = self._file.enter_context(create_product(self.comm, self.directory / self._name, "frames", {}))
        self.trajectory, self.fields = self._writers(file)

    def close(self) -> None:
        """End the open segment, if there is one."""
        if self._name:
            self._file.close()
            self.names.append(self._name)
            self._name = ""

    def release_scales(self) -> dict[str, float]:
        """Scales of the first frame, with the rates between the first two; of closed segments."""
        frames = []
        for name in self.names[:2]:  # the first may hold one frame alone
            with open_product(self.comm, self.directory / name, "frames") as segment:
                stored = Trajectory(segment, "tracers")
                frames += [(time, self._values(stored, frame)) for frame, time in enumerate(stored.times[:2])]
        (start, first), (end, second) = frames[:2]
        return measured_scales(self.comm, first, first, second, end - start)

    def assemble(self, file: File) -> None:
        """Copy the frames of all segments into a product."""
        self.close()
        trajectory, fields = self._writers(file)
        slab = SlabDecomposition(self.comm, BOX_LENGTH, self.settings.cells)
        start, _ = id_block(self.comm, self.settings.particles)
        for name in self.names:
            with open_product(self.comm, self.directory / name, "frames") as segment:
                frames, series = Trajectory(segment, "tracers"), FieldSeries(segment, "filtered")
                for frame, (step, time) in enumerate(zip(frames.steps, frames.times)):
                    trajectory.append(step, time, start, self._values(frames, frame))
                for index, time in enumerate(series.times):
                    planes = {name: series.read(index, name, slab.start, slab.stop) for name in series.variables}
                    fields.append(time, slab.start, planes)

    def __enter__(self) -> FrameSegments:
        return self

    def __exit__(self, *raised) -> None:
        self._file.__exit__(*raised)

    def _values(self, frames: Trajectory, frame: int) -> dict[str, np.ndarray]:
        """This rank's block of all columns of a frame."""
        block = id_block(self.comm, self.settings.particles)
        return {column: frames.read(frame, column, *block) for column in frames.columns}

    def _writers(self, file: File) -> tuple[TrajectoryWriter, FieldWriter]:
        settings = self.settings
        trajectory = TrajectoryWriter(file, "tracers", settings.particles, BOX_LENGTH,
                                      {"position": (3,), "velocity": (3,), **self.scalar}, np.float64)
        variables = {"velocity": 3, **dict.fromkeys(self.scalar, 1)}
        return trajectory, FieldWriter(file, "filtered", settings.cells, variables)
