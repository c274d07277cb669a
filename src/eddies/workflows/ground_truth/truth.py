"""Read the ground truth: frames of particles, fields and scales."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

from eddies.io.fields import FieldSeries
from eddies.io.hdf5 import File, ProductError, open_product, read_attributes
from eddies.io.trajectories import Trajectory
from eddies.parallel.broadcast import on_all_ranks
from eddies.parallel.communicator import Comm
from eddies.parallel.migration import id_block, migrate
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.flow_units import RATES, ReferenceScales, planes_for
from eddies.scene.terms import Forcing

CPU = torch.device("cpu")
Result = TypeVar("Result")


class GroundTruth:
    """An open ground_truth.h5 that all ranks read. A particle is on the rank whose slab of `decomposition` holds it.

    `planes` is the number of planes of all slabs together. By default it is the number of planes of the grid of the
    resolved velocity. The methods return arrays on the host; training and rollouts copy them to `device`.

    For an incompressible fluid no density is stored: `has_density` is false, and columns of the density are missing.
    All ranks raise ProductError if one of them reads a value that is not finite.
    """

    def __init__(self, file: File, comm: Comm, device: torch.device = CPU, planes: int | None = None) -> None:
        self.device, self._file = device, file
        self.trajectory, self.fields = Trajectory(file, "tracers"), FieldSeries(file, "filtered")
        self.times, self.total = self.trajectory.times, self.trajectory.total
        self.decomposition = SlabDecomposition(comm, self.trajectory.length, planes or planes_for(self.total))
        self.reference = read_attributes(file, "reference")
        #: the forcing after the release of the tracers, None if there is none
        self.forcing = Forcing(**read_attributes(file, "forcing")) if "forcing" in file else None
        self.has_density = "density" in self.trajectory.columns
        self._evolving = ("velocity", "density") if self.has_density else ("velocity",)

    @cached_property
    def states(self) -> FieldSeries:
        """The unfiltered flow at the few times at which it is stored."""
        return FieldSeries(self._file, "unfiltered")

    @property
    def scales(self) -> ReferenceScales:
        """Reference scales of the flow at the release of the tracers. Scales of a missing density are None."""
        r = self.reference
        density = ({"density": r["density_rms"], "density_rate": r["density_rate_rms"],
                    "sound_speed": r["sound_speed"]} if self.has_density else {})
        return ReferenceScales(
            filter_width=r["filter_width"], spacing=r["spacing"], velocity=r["velocity_rms"],
            acceleration=r["acceleration_rms"], density_mean=r["density_mean"], viscosity=r["viscosity"],
            kolmogorov_length=r["kolmogorov_length"], **density)

    def particles(self, frame: int) -> dict[str, np.ndarray]:
        """Return the columns `id`, `position`, `velocity` and, if stored, `density` of this rank's particles in a
        frame."""
        return migrate(self.decomposition, self.block(frame))

    def particles_with_rates(self, frame: int) -> dict[str, np.ndarray]:
        """Return the columns of `particles` with the rates `acceleration` (n, 3) and, if a density is stored,
        `density_rate` (n,).

        The rates are centred differences along trajectories. Raises ValueError for the first and the last frame.
        """
        if not 0 < frame < len(self.times) - 1:
            raise ValueError(f"frame {frame} of {len(self.times)}: rates need the frame before and the frame after it")
        columns = self.block(frame)
        before, after = (self.block(other, self._evolving) for other in (frame - 1, frame + 1))
        span = self.times[frame + 1] - self.times[frame - 1]
        for name in self._evolving:
            columns[RATES[name]] = (after[name] - before[name]) / span
        return migrate(self.decomposition, columns)

    def window(self, frame: int, length: int) -> dict[str, np.ndarray]:
        """Return the columns of a frame, and values of the same particles in the next `length` frames: `position_later`
        and `velocity_later` (n, length, 3), `density_later` (n, length). They are those of this rank's block of ids."""
        columns = self.block(frame)
        later = [self.block(frame + number) for number in range(1, length + 1)]
        for name in ("position", *self._evolving):
            columns[f"{name}_later"] = np.stack([block[name] for block in later], axis=1)
        return columns

    def planes(self, series: FieldSeries, index: int, variable: str, slab: SlabDecomposition) -> np.ndarray:
        """Return a variable on the planes of a slab, (components, z_local, y, x), in double precision.

        `series` is `fields` or `states`, and `index` is the number of the field in this series.
        """
        return self._together(lambda: series.read(index, variable, slab.start, slab.stop)).astype(np.float64)

    @cached_property
    def field_frames(self) -> list[int]:
        """The frames at the times of the filtered fields."""
        return self._frames_of(self.fields)

    @cached_property
    def state_frames(self) -> list[int]:
        """The frames at the times of the unfiltered flow; none for measured tracks."""
        return [] if "tracks" in self._file else self._frames_of(self.states)

    def field_at(self, frame: int, points: torch.Tensor) -> np.ndarray:
        """Return the stored filtered velocity (m, 3) at the time of a frame. `points` (m, 3) are the grid points of the
        field on this rank."""
        cells, index = self.fields.cells, self.field_frames.index(frame)
        planes = len(points) // cells**2
        first = round(float(points[0, 2]) * cells / self.decomposition.length) if planes else 0
        field = self._together(lambda: self.fields.read(index, "velocity", first, first + planes))
        return field.reshape(3, -1).T.astype(np.float64)

    def block(self, frame: int, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """Return the ids and the columns `names` (by default all) of a frame, for the particles in this rank's block of
        ids."""
        start, stop = id_block(self.decomposition.comm, self.total)
        names = ("position", *self._evolving) if names is None else names
        columns = self._together(lambda: {name: self.trajectory.read(frame, name, start, stop) for name in names})
        return {"id": np.arange(start, stop, dtype=np.int64), **columns}

    def _frames_of(self, series: FieldSeries) -> list[int]:
        return [int(np.argmin(np.abs(self.times - time))) for time in series.times]

    def _together(self, read: Callable[[], Result]) -> Result:
        """Read on this rank. If one rank raises ProductError, all ranks raise it."""
        return on_all_ranks(self.decomposition.comm, read, ProductError)


@contextmanager
def open_truth(comm: Comm, path: Path, device: torch.device = CPU, planes: int | None = None) -> Iterator[GroundTruth]:
    """Open a ground_truth.h5; collective."""
    with open_product(comm, path, "ground_truth") as file:
        yield GroundTruth(file, comm, device, planes)
