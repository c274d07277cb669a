"""Read the ground truth for training and simulation: frames of particles on slabs, fields and scales."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TypeVar

import numpy as np
import torch

from eddies.io.fields import FieldSeries
from eddies.io.hdf5 import File, ProductError, read_attributes
from eddies.io.trajectories import Trajectory
from eddies.learning.force_training import FieldLater, TrainingFrame
from eddies.parallel.broadcast import on_all_ranks
from eddies.parallel.migration import id_block, migrate
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.flow_units import RATES, ReferenceScales
from eddies.particles.model import LagrangianModel
from eddies.particles.particle_field import grid_points
from eddies.particles.particle_set import ParticleSet
from eddies.particles.periodic_box import PeriodicBox
from eddies.scene.terms import Forcing
from eddies.workflows.ground_truth.frame_counts import last_seen

log = logging.getLogger("eddies")

Result = TypeVar("Result")


class GroundTruth:
    """An open ground_truth.h5 that all ranks read. A particle is on the rank whose slab of `decomposition` holds it.
    Frames for training and models go to `device`.

    For an incompressible fluid no density is stored: `has_density` is false and columns of the density are missing.
    All ranks raise ProductError if one of them reads a value that is not finite.
    """

    def __init__(self, file: File, decomposition: SlabDecomposition,
                 device: torch.device = torch.device("cpu")) -> None:
        self.decomposition, self.device, self._file = decomposition, device, file
        self.trajectory, self.fields = Trajectory(file, "tracers"), FieldSeries(file, "filtered")
        self.times, self.total = self.trajectory.times, self.trajectory.total
        self.reference = read_attributes(file, "reference")
        #: the forcing after the release of the tracers, None without one
        self.forcing = Forcing(**read_attributes(file, "forcing")) if "forcing" in file else None
        self.has_density = "density" in self.trajectory.columns
        self._evolving = ("velocity", "density") if self.has_density else ("velocity",)

    @cached_property
    def states(self) -> FieldSeries:
        """The unfiltered flow at the few times at which it is stored."""
        return FieldSeries(self._file, "unfiltered")

    @property
    def scales(self) -> ReferenceScales:
        """Reference scales of the flow at the release of the tracers. Those of a density are None without a density."""
        r = self.reference
        density = ({"density": r["density_rms"], "density_rate": r["density_rate_rms"],
                    "sound_speed": r["sound_speed"]} if self.has_density else {})
        return ReferenceScales(
            filter_width=r["filter_width"], spacing=r["spacing"], velocity=r["velocity_rms"],
            acceleration=r["acceleration_rms"], density_mean=r["density_mean"], viscosity=r["viscosity"],
            kolmogorov_length=r["kolmogorov_length"], **density)

    def particles(self, frame: int) -> dict[str, np.ndarray]:
        """id, position, velocity and, if stored, density of this rank's particles at a frame."""
        return migrate(self.decomposition, self.block(frame))

    def particles_with_rates(self, frame: int) -> dict[str, np.ndarray]:
        """The same with `acceleration` (n, 3) and `density_rate` (n,), by centred differences along trajectories.

        Raises ValueError for the first and the last frame.
        """
        if not 0 < frame < len(self.times) - 1:
            raise ValueError(f"frame {frame} of {len(self.times)} has no frames on both sides")
        columns = self.block(frame)
        before, after = (self.block(other, self._evolving) for other in (frame - 1, frame + 1))
        span = self.times[frame + 1] - self.times[frame - 1]
        for name in self._evolving:
            columns[RATES[name]] = (after[name] - before[name]) / span
        return migrate(self.decomposition, columns)

    def window(self, frame: int, length: int) -> dict[str, np.ndarray]:
        """`particles` of a frame, with their values in the next frames: `position_later` and `velocity_later`
        (n, length, 3), `density_later` (n, length)."""
        columns = self.block(frame)
        later = [self.block(frame + number) for number in range(1, length + 1)]
        for name in ("position", *self._evolving):
            columns[f"{name}_later"] = np.stack([block[name] for block in later], axis=1)
        return migrate(self.decomposition, columns)

    def field(self, index: int, variable: str, slab: SlabDecomposition | None = None) -> np.ndarray:
        """The planes of a slab (default: that of the particles) of a filtered field, (components, z_local, y, x), in
        double precision."""
        return self._planes(self.fields, index, variable, slab or self.decomposition)

    def state(self, index: int, variable: str, slab: SlabDecomposition) -> np.ndarray:
        """The same of a field of the unfiltered flow."""
        return self._planes(self.states, index, variable, slab)

    @cached_property
    def at_fields(self) -> list[int]:
        """The frames at the times of the filtered fields."""
        return [int(np.argmin(np.abs(self.times - time))) for time in self.fields.times]

    def field_at(self, frame: int, points: torch.Tensor) -> np.ndarray:
        """The stored filtered velocity (m, 3) at the time of a frame, at the `grid_points` (m, 3) of this rank."""
        cells, index = self.fields.cells, self.at_fields.index(frame)
        planes = len(points) // cells**2
        first = round(float(points[0, 2]) * cells / self.decomposition.length) if planes else 0
        field = self._together(lambda: self.fields.read(index, "velocity", first, first + planes))
        return field.reshape(3, -1).T.astype(np.float64)

    def last_frame_seen(self, window: float) -> int:
        """The last frame of the training window, a fraction of the ground truth; 0 without a window."""
        return last_seen(window, len(self.times)) if window > 0 else 0

    def block(self, frame: int, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """The named columns, or all, of this rank's block of ids at a frame."""
        start, stop = id_block(self.decomposition.comm, self.total)
        names = ("position", *self._evolving) if names is None else names
        columns = self._together(lambda: {name: self.trajectory.read(frame, name, start, stop) for name in names})
        return {"id": np.arange(start, stop, dtype=np.int64), **columns}

    def _planes(self, series: FieldSeries, index: int, variable: str, slab: SlabDecomposition) -> np.ndarray:
        return self._together(lambda: series.read(index, variable, slab.start, slab.stop)).astype(np.float64)

    def _together(self, read: Callable[[], Result]) -> Result:
        """Read on this rank; all ranks raise the ProductError of one."""
        return on_all_ranks(self.decomposition.comm, read, ProductError)


def load_frame(truth: GroundTruth, index: int, model: LagrangianModel, dtype: torch.dtype,
               with_field: bool = False) -> TrainingFrame:
    """A frame with its true rates, and `with_field` also the filtered field one frame later; collective.

    The particles have the true density if the model integrates the density.
    """
    columns = truth.particles_with_rates(int(index))
    rates = {name: torch.from_numpy(columns[name]).to(truth.device, dtype)
             for name in ("acceleration", "density_rate") if name in columns}
    dynamics = ParticleDynamics(truth.decomposition, model, skin=0.0, dtype=dtype)
    later = _field_after(truth, int(index), dtype) if with_field else None
    frame = TrainingFrame(dynamics, particles_for(model, columns, truth.device), rates["acceleration"],
                          rates.get("density_rate"), later)
    solves = [] if dynamics.resolution is None else dynamics.resolution.solves
    for iterations, residual, converged in solves:
        if not converged and truth.decomposition.comm.rank == 0:
            log.warning("frame %d: a solve for the resolved velocity did not converge in %d iterations, residual %.1e",
                        index, iterations, residual)
    return frame


def _field_after(truth: GroundTruth, frame: int, dtype: torch.dtype) -> FieldLater:
    """The filtered field one frame after a frame, and the positions of the particles at that time."""
    slab, device = truth.decomposition, truth.device
    columns = truth.window(frame, 1)  # rows as in `particles_with_rates`
    position, later = (torch.from_numpy(columns[name]) for name in ("position", "position_later"))
    # Stored positions are wrapped into the box; these continue from the positions of the frame.
    moved = position + PeriodicBox(slab.length).displacement(later[:, 0], position)
    points = grid_points(slab, truth.fields.cells)
    field = torch.from_numpy(truth.field_at(frame + 1, points))
    return FieldLater(moved.to(device), torch.from_numpy(columns["velocity_later"][:, 0]).to(device, dtype),
                      float(truth.times[frame + 1] - truth.times[frame - 1]), points.to(device),
                      field.to(device, dtype))


def particles_for(model: LagrangianModel, columns: dict[str, np.ndarray], device: torch.device) -> ParticleSet:
    """The true particles as a start for a model; with their density only if the model integrates it."""
    particles = ParticleSet.from_numpy(columns, device)
    return particles if model.integrates_density else replace(particles, density=None)
