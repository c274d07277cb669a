"""The particles of each frame, from measured tracks or a ground truth, and the solver that fits them."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from eddies.analysis.linear_flow import LinearFlow
from eddies.io.hdf5 import File, in_files, read_attributes
from eddies.io.track_files import read_points
from eddies.parallel.communicator import Comm
from eddies.particles.particle_set import ParticleSet
from eddies.particles.resolved_velocity import ResolvedVelocity
from eddies.scene.scene import BOX_LENGTH, Reconstruction, SceneError, Tracers, Tracks
from eddies.workflows.ground_truth.track_frames import TrackFrames, count_for, read_measured, surest
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.track_solver import NO_FILTER, best_solver, particles_on, slabs_for, solver_of

NEAREST = 0.500001  # largest distance in time between a point and its frame, in frame intervals
FAR = 1e6           # largest coordinate of a point in a periodic cube, in edges; wrapping takes its digits


def read_placed(path: Path, unit: float, corner: np.ndarray, periodic: bool,
                times: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray | None]:
    """Read points: their places in the run's cube, in its units, and their frames, or None if a point is in all of
    them. Without the `times` of the frames they are not found. `unit`, `corner`, `periodic` are those of a `Source`.

    Raises ProductError if the file cannot be read, SceneError for a point outside.
    """
    time, position = read_points(path)
    placed, frames, span = (position + corner) / unit, None, ""
    bad = ((np.abs(placed) > FAR * BOX_LENGTH) if periodic else (placed < 0) | (placed >= BOX_LENGTH)).any(1)
    if time is not None and times is not None:
        frames, span = np.abs(times - time[:, None]).argmin(1), f", or the times from 0 to {times[-1]:g}"
        bad |= np.abs(times[frames] - time) > NEAREST * np.diff(times).max(initial=0.0)
    if bad.any():
        row, around = int(np.argmax(bad)), f"{FAR:g} edges around the cube" if periodic else "cube around the volume"
        place, when = ", ".join(f"{x:.4g}" for x in position[row]), "" if time is None else f", {time[row]:g}"
        raise SceneError(f"[reconstruction] points: {path}: ({place}{when}) is outside the {around}{span} "
                         f"({bad.sum()} such points); remove it")
    return placed, frames


def check_points(path: Path, tracks: Tracks | None) -> None:
    """Raise an error if points cannot be used, whatever their times are; one rank calls it."""
    about = {"length_unit": 1.0, "corner": np.zeros(3)} if tracks is None else read_measured(tracks).about
    read_placed(path, about["length_unit"], about["corner"], tracks is None or tracks.volume is None)


class GivenPoints:
    """The points of [reconstruction] points in the frames with these `times`. The constructor is collective.

    A point with a time is in the frame that is nearest in time, a point without one in all frames.

    Attributes
    ----------
    most : largest number of points in a frame.

    Raises the errors of `read_placed`.
    """

    def __init__(self, source: Source, path: Path, times: np.ndarray) -> None:
        self._slab = source.slab
        self._position, self._frames = in_files(self._slab.comm, path, lambda: read_placed(
            path, source.unit, source.corner, source.periodic, times))
        self.most = len(self._position) if self._frames is None else int(np.bincount(self._frames).max())

    def at(self, number: int) -> ParticleSet:
        """Return this rank's points in frame `number` of `times`, as particles at rest; the id is the row of the file,
        from 0 on. Collective."""
        rows = np.arange(len(self._position)) if self._frames is None else np.flatnonzero(self._frames == number)
        rows = rows[self._slab.rank::self._slab.size]
        place = self._position[rows] % BOX_LENGTH
        return particles_on(self._slab, {"id": rows, "position": place, "velocity": np.zeros_like(place)})


class Source:
    """Reads the particles of each frame, from measured tracks or from a ground truth. The constructor is collective.

    Attributes
    ----------
    times : times of the frames.
    spacing : mean distance of the particles.
    scales : reference scales of the flow, by name. For unfiltered velocities `filter_width` is NO_FILTER times the
        spacing. `spacing` is that of particles that would resolve the modes in one frame (`Reconstruction.resolving`).
    slab : this rank's part of the box, with the planes of the grid of the modes.
    most : largest number of particles in a frame.
    truth : the ground truth with true fields; None for measured tracks.
    periodic : whether the cube is a period of the flow, and no volume lies in it.
    uniform : whether all measured tracks of a frame have the same velocity.
    periods : numbers of periods of the flow in the cube along x, y and z.
    background : the mean flow beside which the particles' velocities are; None without one.
    filtered : whether the tracks follow a filtered velocity.
    unit : the scene's unit of length, in the unit of the tracks.
    velocity_errors, error_weights : as in `MeasuredTracks`; errors are zero without measured tracks.
    corner : position of the origin of the tracks' coordinates in the cube, in the unit of the tracks.
    """

    def __init__(self, tracks: Tracks | None, tracers: Tracers, settings: Reconstruction, file: File,
                 comm: Comm) -> None:
        self._tracks, self.truth, self.spacing, self.uniform = None, None, tracers.spacing, False
        self.error_weights, self.periods = np.ones(1), np.ones(3, int)
        self._fitted: dict[float, tuple[ResolvedVelocity, float, Tensor]] = {}
        self.background: LinearFlow | None = None
        self.periodic = tracks is None or tracks.volume is None
        self.filtered, width = (tracks or tracers).filtered, tracers.filter_width
        if tracks is not None:
            self._tracks = source = TrackFrames(comm, tracks)
            self.times, self.spacing, self.most = source.times, source.spacing, source.most
            self.uniform, self.background = source.uniform, source.background
            self.unit, self.corner = source.about["length_unit"], source.about["corner"]
            self.periods = source.about["periods"]
            self.velocity_errors, self.error_weights = source.velocity_errors, source.error_weights
            tracers = tracers.with_count(count_for(self.spacing))
        resolved = settings.resolving(tracers, self.filtered)
        width = width if self.filtered else NO_FILTER * self.spacing
        self.scales = read_attributes(file, "reference") | {"spacing": resolved.spacing, "filter_width": width}
        self.slab = slabs_for(comm, tracers, resolved, width, self.scales["kolmogorov_length"])
        if tracks is None:
            self.truth = truth = GroundTruth(file, comm, planes=self.slab.planes)
            self.times, self.most, self.velocity_errors = truth.times, truth.total, np.zeros((len(truth.times), 2))
            self.unit, self.corner = 1.0, np.zeros(3)

    @property
    def surest(self) -> int:
        """The frame with the smallest `velocity_errors`."""
        return surest(self.velocity_errors)

    def particles(self, frame: int) -> ParticleSet:
        """Return this rank's particles of a frame, with position and velocity; collective."""
        if self._tracks is not None:
            return particles_on(self.slab, self._tracks.frame(frame))
        columns = self.truth.particles(frame)
        return ParticleSet.from_numpy({name: columns[name] for name in ("id", "position", "velocity")})

    def fitted(self, share: float) -> tuple[ResolvedVelocity, float, Tensor]:
        """Return the solver with the best weight of the noise for the surest frame (`best_solver`), this weight, and
        the transfer function of the filter that the particles' velocity has passed; collective."""
        if share not in self._fitted:
            solver, weight, _ = best_solver(self.particles(self.surest),
                                            partial(solver_of, self.slab, self.scales, self.periods, self.filtered),
                                            share, self.uniform)
            grid = solver.grid
            self._fitted[share] = solver, weight, (grid.filter_transfer(self.scales["filter_width"]) if self.filtered
                                                   else torch.ones_like(grid.shell))
        return self._fitted[share]
