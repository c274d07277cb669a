"""What rollout.h5 stores: the model's particles, the true ones at the same times, what is measured of both alike."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from eddies.io.frame_segments import FieldLayout, FrameLayout, FrameSegments
from eddies.io.hdf5 import File
from eddies.parallel.migration import IdOrder, migrate
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.particle_field import ParticleField
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.particles.smoothing_kernels import SmoothingKernel
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.rollout.method import GridModes
from eddies.workflows.rollout.particle_spectra import ParticleSpectra

COLUMNS = {"position": (3,), "velocity": (3,), "density": (), "acceleration": (3,)}
GRADIENT = {"velocity_gradient": (3, 3)}
FIELDS = "model", "truth", "filtered"


class RolloutFrames:
    """Stores frames of the model and, as long as the ground truth lasts, of the true tracers and the filtered field.

    Velocity gradients at the particles and velocities on the grid of the filtered fields are averages with the
    learned kernel, for model and truth alike; without a kernel neither
    they nor the filtered fields are stored. Spectra are found where there is a filtered field to compare with, and of
    the model alone where there is no true frame. `times` are those of the model's frames. `density`: whether the
    model's particles have one; it is stored where the true ones have one too. `segments` are the files in a directory
    that take the frames; `names` those that are closed.
    """

    def __init__(self, directory: Path, truth: GroundTruth, kernel: SmoothingKernel | None, start_time: float,
                 density: bool, names: Sequence[str] = ()) -> None:
        self.truth, self.kernel, self.start_time = truth, kernel, start_time
        self.times: list[float] = []
        self.spectra = ParticleSpectra(truth)
        comm, length = truth.decomposition.comm, truth.decomposition.length
        cells = truth.fields.cells
        self._slab = SlabDecomposition(comm, length, cells)
        self._grid = SpectralGrid(self._slab, "float32", cutoff=(cells - 1) // 2)
        self._columns = {name: shape for name, shape in COLUMNS.items()
                         if name != "density" or density and truth.has_density}
        self._stored = self._columns | (GRADIENT if kernel else {})
        layout = FrameLayout(truth.total, length, dict.fromkeys(("model", "truth"), self._stored), np.float32,
                             dict.fromkeys(FIELDS if kernel else (), FieldLayout(cells, {"velocity": 3})))
        self.segments = FrameSegments(comm, directory, layout, names)

    def store(self, step: int, time: float, particles: ParticleSet, acceleration: torch.Tensor,
              near: GridModes | None = None) -> None:
        """Store the model's particles and what is true at that time; `time` counts from the start of the rollout.
        `near`: a velocity that is known to be near the particles'."""
        self.times.append(time)
        self.segments.open(step)
        frame = self._true_frame(time)
        field = None if frame is None else self._true_field(frame)
        columns = {**particles.to_numpy(), "acceleration": as_numpy(acceleration)}
        if frame is None or field is not None:
            self.spectra.add("model", time, columns, near)
        self._store("model", step, time, columns)
        if frame is None:
            return
        columns = self.truth.particles_with_rates(frame)
        if field is not None:
            planes = self.truth.field(field, "velocity", self._slab)
            self.spectra.add("truth", time, columns, (self._grid, self._grid.forward(planes)))
            if self.kernel is not None:
                self.segments.fields["filtered"].append(time, self._slab.start, {"velocity": planes})
        self._store("truth", step, time, columns)

    def write(self, file: File) -> None:
        """Write all that was stored into a product; collective."""
        self.segments.assemble(file)
        self.spectra.write(file)

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint must hold of the frames beside the files of `segments`."""
        return {"times": self.times, "spectra": self.spectra.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`."""
        self.times = state["times"]
        self.spectra.load_state_dict(state["spectra"])

    def _store(self, name: str, step: int, time: float, columns: dict[str, np.ndarray]) -> None:
        columns = migrate(self._slab, {column: columns[column] for column in ("id", *self._columns)})
        if self.kernel is not None:
            position, velocity = (torch.from_numpy(columns[column]) for column in ("position", "velocity"))
            particle_field = ParticleField(self._slab, self.kernel.support, position, velocity)
            volume, n = particle_field.volumes(self.kernel), self._slab.planes
            columns["velocity_gradient"] = as_numpy(particle_field.at_particles(self.kernel, volume)[1])
            field = as_numpy(particle_field.velocity_on_whole_grid(self.kernel, volume)).T
            planes = field.reshape(3, self._slab.count, n, n)
            self.segments.fields[name].append(time, self._slab.start, {"velocity": planes})
        order = IdOrder(self._slab.comm, columns["id"], self.truth.total)
        by_id = {column: order.apply(columns[column]) for column in self._stored}
        self.segments.trajectories[name].append(step, time, order.start, by_id)

    def _true_frame(self, time: float) -> int | None:
        """The frame of the ground truth at a time of the rollout, if there is one with rates."""
        times = self.truth.times
        frame = int(np.argmin(np.abs(times - (self.start_time + time))))
        reached = abs(times[frame] - (self.start_time + time)) < 1e-6 and 0 < frame < len(times) - 1
        return frame if reached else None

    def _true_field(self, frame: int) -> int | None:
        """The filtered field of a frame of the ground truth, if it has one."""
        field = int(np.argmin(np.abs(self.truth.fields.times - self.truth.times[frame])))
        return field if abs(self.truth.fields.times[field] - self.truth.times[frame]) < 1e-9 else None
