"""Frames of measured tracks in the units of a scene. Splines give missing velocities. Tracks may have gaps."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from eddies.analysis.track_splines import smooth
from eddies.clock import SAME
from eddies.io.file_patterns import FileVersion, file_versions
from eddies.io.hdf5 import in_files
from eddies.io.track_files import Tracks, check_inside, check_velocities, checked, read_tracks
from eddies.parallel.communicator import Comm
from eddies.parallel.slab import block_starts
from eddies.scene.scene import BOX_LENGTH, SceneError
from eddies.scene.sections import Tracks as Settings

log = logging.getLogger("eddies")

UNEQUAL = 0.01    # largest deviation of a time from equal intervals, divided by the interval
EQUAL = 1e-12     # fraction of a velocity below which velocities are equal
LEAST_FRAMES = 3
FITTING = 1.05    # factor by which the noise that tracks show may differ from the given one
MARGIN = 4.0      # distance between a volume and its periodic image, in mean particle spacings


@dataclass(frozen=True)
class MeasuredTracks:
    """Measured tracks in the units of a scene (box edge 2 pi). A row is a particle in a frame. Rows are sorted by
    frame, then by id.

    Parameters
    ----------
    times : times of the frames, from 0 on, (frames,).
    starts : first row of each frame, and at the end the number of rows, (frames + 1,).
    columns : `id` (rows,), `position` and `velocity` (rows, 3). With [tracks] sound_speed also `density` (rows,), in
        units of its mean.
    uniform : whether all tracks of a frame have the same velocity, in each frame.
    throughout : whether the track of a row is present in all frames, (rows,).
    spacing : mean particle spacing, the cube root of (volume with particles / mean number of rows of a frame).
    about : the attributes of the product that describe the file and the tracks. `length_unit` is the scene's unit of
        length, in the unit of the file. `corner` is the position in the periodic cube of the origin of the file's
        coordinates, in the unit of the file.
    """

    times: np.ndarray
    starts: np.ndarray
    columns: Mapping[str, np.ndarray]
    uniform: bool
    throughout: np.ndarray
    spacing: float
    about: Mapping[str, Any]

    @property
    def mean_count(self) -> float:
        """Mean number of rows of a frame."""
        return len(self.throughout) / len(self.times)

    @property
    def complete(self) -> int:
        """Number of tracks that are present in all frames."""
        return int(self.throughout[:self.starts[1]].sum())

    def frame(self, number: int, complete: bool = False) -> dict[str, np.ndarray]:
        """Return the rows of a frame. If `complete`, only rows of tracks that are present in all frames are returned,
        with new ids 0, 1, ..."""
        rows = np.arange(*self.starts[number:number + 2])
        if not complete:
            return {name: values[rows] for name, values in self.columns.items()}
        rows = rows[self.throughout[rows]]
        return {name: values[rows] for name, values in self.columns.items()} | {"id": np.arange(len(rows))}

    def shared(self, number: int, other: int) -> dict[str, np.ndarray]:
        """Return the rows of frame `number` whose tracks are also in frame `other`."""
        rows, others = (np.arange(*self.starts[frame:frame + 2]) for frame in (number, other))
        rows = rows[np.isin(self.columns["id"][rows], self.columns["id"][others])]
        return {name: values[rows] for name, values in self.columns.items()}


class TrackFrames:
    """The frames of a file with tracks. Rank 0 holds them; the methods divide their rows among the ranks. The
    constructor and all methods are collective."""

    def __init__(self, comm: Comm, settings: Settings) -> None:
        self.comm = comm
        self.times, self.about, self.mean_count, self.complete, self.spacing, self.uniform, self.most = in_files(
            comm, settings.file, lambda: (
                (found := read_measured(settings)).times, found.about, found.mean_count, found.complete, found.spacing,
                found.uniform, int(np.diff(found.starts).max())))
        self._tracks = read_measured(settings) if comm.rank == 0 else None

    def frame(self, number: int, complete: bool = False) -> dict[str, np.ndarray]:
        """Return this rank's block of the rows of a frame; see `MeasuredTracks.frame`."""
        return self._block(lambda tracks: tracks.frame(number, complete))

    def shared(self, number: int, other: int) -> dict[str, np.ndarray]:
        """Return this rank's block of the rows that `MeasuredTracks.shared` returns."""
        return self._block(lambda tracks: tracks.shared(number, other))

    def _block(self, rows: Callable[[MeasuredTracks], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
        blocks = None
        if self._tracks is not None:
            columns, size = rows(self._tracks), self.comm.size
            starts = block_starts(len(columns["id"]), size)
            blocks = [{name: values[start:stop] for name, values in columns.items()}
                      for start, stop in zip(starts, starts[1:])]
        return dict(self.comm.scatter(blocks))


def count_for(spacing: float) -> int:
    """Return the number of particles with this mean spacing that fill the periodic cube."""
    return round((BOX_LENGTH / spacing) ** 3)


def read_measured(settings: Settings) -> MeasuredTracks:
    """Read the tracks of the file of [tracks]; one rank calls it.

    If splines are needed, tracks with fewer than three rows are left out. Raises ProductError if the file cannot be
    used, SceneError if it does not fit [tracks], for example with too few frames.
    """
    return _read_measured(settings, file_versions(settings.file))


@lru_cache(maxsize=1)  # a run reads a file more than once
def _read_measured(settings: Settings, versions: tuple[FileVersion, ...]) -> MeasuredTracks:
    found = read_tracks(settings.file, settings.format, settings.group, settings.frame_rate,
                        settings.columns.given if settings.columns else None)
    found, edge, volume, corner = _placed(found, settings)
    if settings.sound_speed is not None and found.density is None:
        raise SceneError(f"[tracks] sound_speed = {settings.sound_speed:g}: {settings.file} has no densities; remove "
                         "the key")
    period = edge if settings.volume is None else None
    found = _at_frames(found, settings)
    if settings.noise == 0:
        check_velocities(found, period, settings.file)
    times = found.times
    about: dict[str, Any] = {"file": settings.path, "in_file": len(np.unique(found.track))}
    position, velocity = found.position, found.velocity
    if velocity is None or settings.noise > 0:
        splines = smooth(found.time, found.track, position, period, settings.noise)
        order = np.argsort(splines.rows)
        position, velocity = splines.position[order], splines.velocity[order]
        found = found.chosen(splines.rows[order])
        about["smoothing"] = splines.smoothing
        if settings.noise > 0 and not 1 / FITTING < splines.residual / settings.noise < FITTING:
            log.warning("%s", _noise_misfit(settings, splines.residual))
        if len(found.times) < len(times):
            raise SceneError(f"{settings.file}: {len(times) - len(found.times)} of {len(times)} frames have no track "
                             "with three rows or more, which a velocity needs; give the velocities, or longer tracks")
    _, place, counts = np.unique(found.track, return_inverse=True, return_counts=True)
    unit = edge / BOX_LENGTH
    columns = {"id": found.track, "position": position / unit % BOX_LENGTH, "velocity": velocity / unit}
    if settings.sound_speed is not None:
        columns["density"] = found.density / found.density.mean()
    spacing = (volume / (len(found.time) / len(times))) ** (1 / 3) / unit
    uniform = _uniform(columns["velocity"], found.starts, times[1])
    if uniform:
        log.warning("%s: all tracks move alike: the velocity field is uniform, and there are no errors relative to "
                    "its fluctuation", settings.file)
    return MeasuredTracks(times, found.starts, columns, uniform, (counts == len(times))[place], spacing,
                          about | {"length_unit": unit, "corner": corner})


def _uniform(velocity: np.ndarray, starts: np.ndarray, interval: float) -> bool:
    """Return whether the velocities (rows, 3) of each frame differ by no more than the round-off of the velocities, and
    of positions divided by the frame interval."""
    highest, lowest = (extreme.reduceat(velocity, starts[:-1]) for extreme in (np.maximum, np.minimum))
    return bool((highest - lowest).max() <= EQUAL * max(np.abs(velocity).max(), BOX_LENGTH / interval))


def _noise_misfit(settings: Settings, shown: float) -> str:
    """Return the warning for a noise that no smoothing fits; `shown` is the noise that the tracks show."""
    given = f"{settings.file}: noise = {settings.noise:g}"
    if np.isnan(shown):
        return f"{given}: all tracks have three rows, which is too short to remove noise; give longer tracks"
    if shown > settings.noise:
        return (f"{given}: the tracks show more noise, {shown:.3g}, which is used; correct noise, or check that errors "
                "of successive frames are independent")
    return (f"{given}: the tracks show less noise: the residuals of a parabola for each track are {shown:.3g}, and "
            "velocities are those of parabolas; lower noise if tracks are not parabolas")


def _at_frames(found: Tracks, settings: Settings) -> Tracks:
    """Return the tracks with the times 0, h, 2 h, ..., in the time unit of the velocities. The frame interval h is
    rounded to six digits.

    Raises SceneError for too few frames, unequal intervals or a frame without tracks.
    """
    path, gaps = settings.file, np.diff(found.times)
    gaps = gaps[gaps > SAME * gaps.max(initial=0.0)]
    if len(gaps) + 1 < LEAST_FRAMES:
        raise SceneError(f"{path}: has {len(gaps) + 1} frames; at least {LEAST_FRAMES} are needed")
    last = round((found.time[-1] - found.time[0]) / float(np.median(gaps)))
    interval = (found.time[-1] - found.time[0]) / last
    frame = np.rint((found.time - found.time[0]) / interval)
    off = np.abs(found.time - found.time[0] - frame * interval)
    if off.max() > UNEQUAL * interval:
        raise SceneError(f"{path}: frames at equal intervals are needed, but the frame at time "
                         f"{found.time[np.argmax(off)]:g} does not fit the interval {interval:g}; interpolate the "
                         "tracks to equal intervals")
    missing = np.setdiff1d(np.arange(last), frame)
    if len(missing):
        raise SceneError(f"{path}: no track is there at time {found.time[0] + missing[0] * interval:g} ({len(missing)} "
                         "such frames in all); give a part of the file without such a gap")
    return checked(replace(found, time=frame * float(f"{interval * settings.time_unit:.6g}")), path)


def _placed(found: Tracks, settings: Settings) -> tuple[Tracks, float, float, np.ndarray]:
    """Place the tracks in a periodic cube.

    Returns the tracks with their new positions, the edge of the cube, the measured volume, and the position that the
    origin of the file's coordinates has in the cube. If the measured volume is not periodic, it lies in the middle of a
    larger cube, at least [tracks] margin away from its periodic images.
    """
    if settings.volume is None:
        edge = settings.box if settings.box is not None else found.edge
        if edge is None:
            raise SceneError("[tracks] box: this key is missing, and the file has no periodic cubic box; give "
                             "the edge of the periodic cube, or the volume of the measurement")
        check_inside(found, np.zeros(3), np.full(3, edge), "box", settings.file)
        return found, edge, edge**3, np.zeros(3)
    lower, upper = np.reshape(settings.volume, (3, 2)).T
    check_inside(found, lower, upper, "volume", settings.file)
    whole = float(np.prod(upper - lower))
    spacing = (whole / (len(found.time) / len(found.times))) ** (1 / 3)
    edge = float((upper - lower).max()) + (MARGIN * spacing if settings.margin is None else settings.margin)
    corner = (edge - (upper - lower)) / 2 - lower
    return replace(found, position=found.position + corner), edge, whole, corner
