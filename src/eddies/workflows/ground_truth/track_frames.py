"""Frames of measured tracks in the units of a scene: velocities by splines, gaps and lost tracks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from eddies.analysis.track_splines import smooth
from eddies.io.hdf5 import in_files
from eddies.io.track_files import check_box, read_tracks
from eddies.parallel.communicator import Comm
from eddies.parallel.slab import block_starts
from eddies.scene.scene import BOX_LENGTH, SceneError
from eddies.scene.sections import Tracks

UNEQUAL = 1e-3    # largest relative difference of two intervals between frames
LEAST_FRAMES = 3


@dataclass(frozen=True)
class MeasuredTracks:
    """Rows of tracks in the units of a scene: the edge of the box is 2 pi. They are sorted by frame, then by id.

    Parameters
    ----------
    times : from 0 on, (frames,). starts : first row of each frame, and the number of rows, (frames + 1,).
    columns : id (rows,), position and velocity (rows, 3), and density (rows,) over its mean, if it was asked for.
    throughout : whether the track of a row is there in all frames, (rows,).
    unit : of length, in that of the file.
    about : words and numbers on the file and on what was left out.
    """

    times: np.ndarray
    starts: np.ndarray
    columns: Mapping[str, np.ndarray]
    throughout: np.ndarray
    unit: float
    about: Mapping[str, str | float]

    @property
    def interval(self) -> float:
        return float((self.times[-1] - self.times[0]) / (len(self.times) - 1))

    @property
    def mean_count(self) -> float:
        """Mean number of rows of a frame."""
        return len(self.throughout) / len(self.times)

    @property
    def complete(self) -> int:
        """Number of tracks that are there in all frames."""
        return int(self.throughout[:self.starts[1]].sum())

    def frame(self, number: int, complete: bool = False) -> dict[str, np.ndarray]:
        """The rows of a frame; `complete`: only those of tracks that are there in all frames, with ids 0, 1, ..."""
        rows = np.arange(*self.starts[number:number + 2])
        if not complete:
            return {name: values[rows] for name, values in self.columns.items()}
        rows = rows[self.throughout[rows]]
        return {name: values[rows] for name, values in self.columns.items()} | {"id": np.arange(len(rows))}


class TrackFrames:
    """The frames of a file with tracks, which rank 0 holds; all ranks make one, and call its methods together."""

    def __init__(self, comm: Comm, settings: Tracks) -> None:
        self.comm = comm
        self.times, self.about, self.mean_count, self.complete = in_files(comm, settings.file, lambda: (
            (found := measured(settings)).times, found.about, found.mean_count, found.complete))
        self._tracks = measured(settings) if comm.rank == 0 else None

    def frame(self, number: int, complete: bool = False) -> dict[str, np.ndarray]:
        """This rank's block of the rows of a frame (`MeasuredTracks.frame`)."""
        blocks = None
        if self._tracks is not None:
            columns, size = self._tracks.frame(number, complete), self.comm.size
            starts = block_starts(len(columns["id"]), size)
            blocks = [{name: values[start:stop] for name, values in columns.items()}
                      for start, stop in zip(starts, starts[1:])]
        return dict(self.comm.scatter(blocks))


def measured(settings: Tracks) -> MeasuredTracks:
    """The tracks of a file; one rank calls it. Tracks with fewer than three rows that need a spline are left out.

    Raises ProductError if the file is unfit, SceneError if it has too few frames.
    """
    state = settings.file.stat() if settings.file.is_file() else None
    return _measured(settings, state and (state.st_size, state.st_mtime_ns))


@lru_cache(maxsize=1)  # a run asks twice
def _measured(settings: Tracks, state: tuple[int, int] | None) -> MeasuredTracks:
    found = read_tracks(settings.file, settings.format, settings.group, settings.interval)
    edge = settings.box if settings.box is not None else found.edge
    if edge is None:
        raise SceneError("[tracks] box: this key is missing, and the file has no cubic box; give the edge of the "
                         "periodic cube")
    if settings.sound_speed is not None and found.density is None:
        raise SceneError(f"[tracks] sound_speed = {settings.sound_speed:g}: {settings.file} has no densities; remove "
                         "the key")
    found = replace(found, time=found.time * settings.time_unit)
    check_box(found, edge, settings.file)
    times, intervals = found.times, np.diff(found.times)
    if len(times) < LEAST_FRAMES:
        raise SceneError(f"{settings.file}: has {len(times)} frames; at least {LEAST_FRAMES} are needed")
    if np.ptp(intervals) > UNEQUAL * intervals.mean():
        raise SceneError(f"{settings.file}: frames follow each other at intervals of {intervals.min():g} to "
                         f"{intervals.max():g}; equal ones are needed")
    about: dict[str, str | float] = {"file": settings.path, "in_file": len(np.unique(found.track))}
    position, velocity = found.position, found.velocity
    if velocity is None or settings.noise > 0:
        splines = smooth(found.time, found.track, position, edge, settings.noise)
        order = np.argsort(splines.rows)
        position, velocity = splines.position[order], splines.velocity[order]
        found = found.chosen(splines.rows[order])
        about["smoothing"] = splines.smoothing
        if len(found.times) < len(times):
            raise SceneError(f"{settings.file}: {len(times) - len(found.times)} of {len(times)} frames have no track "
                             "with three rows or more, which a velocity needs; give the velocities, or longer tracks")
    names, place, counts = np.unique(found.track, return_inverse=True, return_counts=True)
    unit = edge / BOX_LENGTH
    columns = {"id": place, "position": position / unit % BOX_LENGTH, "velocity": velocity / unit}
    if settings.sound_speed is not None:
        columns["density"] = found.density / found.density.mean()
    return MeasuredTracks(times - times[0], found.starts, columns, (counts == len(times))[place], unit,
                          about | {"length_unit": unit})
