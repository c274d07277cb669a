"""Frames of measured tracks in the units of a scene. Splines give missing velocities. Tracks may have gaps."""

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from eddies.analysis.linear_flow import LinearFlow
from eddies.analysis.track_splines import NO_NOISE, smooth
from eddies.clock import SAME
from eddies.io.file_patterns import FileVersion, file_versions
from eddies.io.hdf5 import in_files
from eddies.io.track_files import OFF, Tracks, check_inside, check_velocities, checked, read_tracks
from eddies.io.trajectories import ROUNDING
from eddies.parallel.communicator import Comm
from eddies.parallel.slab import block_starts
from eddies.scene.scene import BOX_LENGTH, SceneError
from eddies.scene.sections import Tracks as Settings

log = logging.getLogger("eddies")

UNEQUAL = 0.01    # largest deviation of a time from equal intervals, divided by the interval
ROUNDED = 0.75    # the same, divided by the last digit of rounded times: a half, and the error of the fitted interval
EQUAL = 1e-12     # fraction of a velocity below which velocities are equal
LEAST_FRAMES = 3
FITTING = 1.05    # factor by which the noise that tracks show may differ from the given one
MARGIN = 4.0      # distance between a volume and its periodic image, in mean particle spacings
FLAT = 0.5        # least thickness of a volume, in mean particle spacings


@dataclass(frozen=True)
class MeasuredTracks:
    """Measured tracks in the units of a scene (box edge 2 pi). A row is a particle in a frame. Rows are sorted by
    frame, then by id.

    Parameters
    ----------
    times : times of the frames, from 0 on, (frames,).
    starts : first row of each frame, and at the end the number of rows, (frames + 1,).
    columns : `id` (rows,), `position` and `velocity` (rows, 3). With [tracks] sound_speed also `density` (rows,), in
        units of its mean. Velocities are those beside the `background`.
    velocity_errors : (frames, 2), rms errors of a velocity component in each frame, by the splines: of what is left of
        the noise, and of what smoothing removes from the motion. They are 0 for velocities of the file.
    error_weights : of the noise of successive positions in the error of a velocity; see `track_splines`.
    background : the mean flow of [tracks] background = "linear"; None without it.
    uniform : whether all tracks of a frame have the same velocity, in each frame.
    throughout : whether the track of a row is present in all frames, (rows,).
    spacing : mean particle spacing, the cube root of (volume with particles / mean number of rows of a frame).
    about : the attributes of the product that describe the file and the tracks. `length_unit` is the scene's unit of
        length, in the unit of the file. `corner` is the position in the periodic cube of the origin of the file's
        coordinates, in the unit of the file. `periods` (3,) are the numbers of periods of the flow in the cube.
    """

    times: np.ndarray
    starts: np.ndarray
    columns: Mapping[str, np.ndarray]
    velocity_errors: np.ndarray
    error_weights: np.ndarray
    background: LinearFlow | None
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


def surest(velocity_errors: np.ndarray) -> int:
    """Return the frame with the smallest `MeasuredTracks.velocity_errors`."""
    return int(np.argmin(np.square(velocity_errors).sum(1)))


class TrackFrames:
    """The frames of a file with tracks. Rank 0 holds them; the methods divide their rows among the ranks. The
    constructor and all methods are collective."""

    def __init__(self, comm: Comm, settings: Settings) -> None:
        self.comm = comm
        (self.times, self.about, self.mean_count, self.complete, self.spacing, self.background, self.uniform,
         self.velocity_errors, self.error_weights, self.most) = in_files(comm, settings.file, lambda: (
             (found := read_measured(settings)).times, found.about, found.mean_count, found.complete, found.spacing,
             found.background, found.uniform, found.velocity_errors, found.error_weights,
             int(np.diff(found.starts).max())))
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
    if settings.sound_speed is not None and found.density is None:
        raise SceneError(f"[tracks] sound_speed = {settings.sound_speed:g}: {settings.file} has no densities; remove "
                         "the key")
    lower, upper, edge, periods = _region(found, settings)
    period = edge if settings.volume is None else None
    about: dict[str, Any] = {"file": settings.path, "in_file": len(np.unique(found.track))}
    smoothed = found.velocity is None or settings.noise not in (None, 0)
    measured, interval = _at_frames(found, settings, settings.longest_gap if smoothed else 0)
    if smoothed:
        found, noise, errors, weights = _smoothed(measured, period, interval, settings, about)
    else:
        check_velocities(measured, period, settings.file)
        found, noise, errors, weights = measured, 0.0, np.zeros((len(measured.time), 2)), np.ones(1)
    if period is None or not _continuous(measured, period, noise):
        check_inside(measured, lower, upper, "box" if period else "volume", settings.file, noise)
    times = interval * np.arange(round(measured.time[-1] / interval) + 1)
    if len(found.times) < len(times):
        raise SceneError(f"{settings.file}: {len(times) - len(found.times)} of {len(times)} frames have no track "
                         "with three rows or more, which a velocity needs; give the velocities, or longer tracks")
    _, place, counts = np.unique(found.track, return_inverse=True, return_counts=True)
    unit, corner = edge / BOX_LENGTH, (edge - (upper - lower)) / 2 - lower
    columns = {"id": found.track, "position": (found.position + corner) / unit % BOX_LENGTH,
               "velocity": found.velocity / unit}
    if settings.sound_speed is not None:
        columns["density"] = found.density / found.density.mean()
    background = None
    if settings.background == "linear":
        background = LinearFlow.fitted(columns["position"], columns["velocity"], np.full(3, BOX_LENGTH / 2))
        columns["velocity"] = columns["velocity"] - background.at(*columns["position"].T).T
        about |= {"background_velocity": background.velocity * unit, "background_gradient": background.gradient}
        log.info("%s: in the middle of the volume the mean velocity is (%s), and the largest component of its gradient "
                 "is %.3g", settings.file, ", ".join(f"{x:.3g}" for x in about["background_velocity"]),
                 np.abs(background.gradient).max())
    spacing = (float(np.prod(upper - lower)) / (len(found.time) / len(times))) ** (1 / 3) / unit
    uniform = _uniform(columns["velocity"], found.starts, times[1])
    if uniform:
        log.warning("%s: all tracks move alike%s: the velocity field is uniform, and there are no errors relative to "
                    "its fluctuation", settings.file, "" if background is None else " beside the background")
    errors = np.sqrt(np.add.reduceat(errors, found.starts[:-1]) / np.diff(found.starts)[:, None]) / unit
    about |= {"length_unit": unit, "corner": corner, "periods": periods}
    return MeasuredTracks(times, found.starts, columns, errors, weights, background, uniform,
                          (counts == len(times))[place], spacing, about)


def _smoothed(found: Tracks, period: float | None, interval: float, settings: Settings,
              about: dict[str, Any]) -> tuple[Tracks, float, np.ndarray, np.ndarray]:
    """Return the tracks with the positions and velocities of splines, the noise of a coordinate, the variances
    (rows, 2) of the errors of a velocity component, and the `error_weights` of the splines.

    A track that lacks more than [tracks] longest_gap frames is divided there; shorter gaps are filled, unless the
    tracks have densities. Attributes of the product are added to `about`.
    """
    file, given = settings.file, None if settings.noise in (None, "auto") else settings.noise
    order = np.lexsort((found.time, found.track))
    same = np.diff(found.track[order]) == 0
    begins = np.append(False, same & (np.diff(found.time[order]) > (settings.longest_gap + 1.5) * interval))
    track = found.track.copy()
    # A part after a gap gets a number of its own.
    parts = np.cumsum(begins)
    later = parts > np.maximum.accumulate(np.where(np.append(True, ~same), parts, 0))
    track[order[later]] = track.max() + parts[later]
    splines = smooth(found.time, track, found.position, period, given, None if found.density is not None else interval)
    order = np.lexsort((splines.track, splines.time))
    rows = splines.rows[order]
    about["smoothing"], noise = splines.smoothing, given
    if given is None:
        noise = 0.0 if splines.smoothing == NO_NOISE else splines.residual
        log.info("%s: the noise of a coordinate is %s", file, f"about {noise:.2g}, by the residuals of the tracks"
                 if noise else "too small to be estimated")
    elif given > 0 and not 1 / FITTING < splines.residual / given < FITTING:
        log.warning("%s", _noise_misfit(settings, splines.residual))
        noise = float(np.fmax(given, splines.residual))  # the residual of tracks of three rows is NaN
    errors = noise**2 * splines.velocity_errors[order]
    about |= {"noise": noise, "velocity_noise": float(np.sqrt(errors[:, 0].sum() / max(len(errors), 1)))}
    counts = {"tracks are divided at gaps": begins.sum(), "rows are added in gaps": np.sum(rows < 0),
              "tracks of fewer than three rows are left out": len(np.unique(track)) - len(np.unique(splines.track))}
    for what, count in counts.items():
        if count:
            log.info("%s: %d %s", file, count, what)
    tracks = Tracks(np.rint(splines.time[order] / interval) * interval, splines.track[order], splines.position[order],
                    splines.velocity[order], None if found.density is None else found.density[rows])
    return tracks, noise, errors, splines.error_weights


def _continuous(found: Tracks, edge: float, noise: float) -> bool:
    """Return whether positions are those of tracks that leave a periodic cube and go on: they start within a cube of
    this edge, at any place, and do not jump."""
    first = np.unique(found.track, return_index=True)[1]
    order = np.lexsort((found.time, found.track))
    moved = np.abs(np.diff(found.position[order], axis=0))[np.diff(found.track[order]) == 0]
    return bool((np.ptp(found.position[first], axis=0) <= edge + 2 * OFF * noise).all()
                and moved.max(initial=0.0) < edge / 2)


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


def _at_frames(found: Tracks, settings: Settings, longest_gap: int) -> tuple[Tracks, float]:
    """Return the tracks with the times 0, h, 2 h, ..., in the time unit of the velocities, and h. The frame interval h
    is rounded to six digits.

    Raises SceneError for too few frames, unequal intervals, or more than `longest_gap` frames without tracks.
    """
    path, times = settings.file, found.times
    if len(times) >= LEAST_FRAMES:
        times, interval = _frames_of(found)
    if len(times) < LEAST_FRAMES:
        raise SceneError(f"{path}: has {len(times)} frames; at least {LEAST_FRAMES} are needed")
    lacking = np.rint(np.diff(times) / interval).astype(int) - 1
    gaps = np.flatnonzero(lacking > longest_gap)
    if len(gaps):
        count, first = lacking[gaps[0]], times[gaps[0]] + interval
        until = f" to {times[gaps[0] + 1] - interval:g}" if count > 1 else ""
        remedy = "" if count > settings.longest_gap else ', or set noise = "auto", so that splines fill the gaps'
        raise SceneError(f"{path}: no track is there at time {first:g}{until} ({count} frames; {len(gaps)} such gaps "
                         f"in all), so the file has a gap or several recordings; give a part without gaps{remedy}")
    numbers = np.cumsum(np.append(0, lacking + 1))
    interval, origin = (times[-1] - times[0]) / numbers[-1], times[0]
    rounding = _rounding(times, interval)
    if rounding > 0:
        interval, origin = np.polyfit(numbers, times, 1)
    frame = np.rint((found.time - origin) / interval)
    off = np.abs(found.time - origin - frame * interval)
    if off.max() > max(UNEQUAL * interval, ROUNDED * rounding):
        raise SceneError(f"{path}: frames at equal intervals are needed, but the frame at time "
                         f"{found.time[np.argmax(off)]:g} does not fit the interval {interval:g}; interpolate the "
                         "tracks to equal intervals")
    if off.max() > UNEQUAL * interval:
        log.info("%s: times are rounded to %g; frames are at equal intervals of %.6g", path, rounding, interval)
    interval = float(f"{interval * settings.time_unit:.6g}")
    return checked(replace(found, time=(frame - frame.min()) * interval), path), interval


def _frames_of(found: Tracks) -> tuple[np.ndarray, float]:
    """Return the times of the frames, in the time of the file, and their mean interval. Times that differ by less than
    half of the median step along tracks are those of one frame."""
    order = np.lexsort((found.time, found.track))
    steps = np.diff(found.time[order])[np.diff(found.track[order]) == 0]
    step = float(np.median(steps if len(steps) else np.diff(found.times)))
    first = np.append(0, np.flatnonzero(np.diff(found.times) > step / 2) + 1)
    times = np.add.reduceat(found.times, first) / np.diff(np.append(first, len(found.times)))
    gaps = np.diff(times)
    return times, float(np.mean(gaps[gaps <= 1.5 * step * (1 + SAME)])) if len(gaps) else step


def _rounding(times: np.ndarray, interval: float) -> float:
    """Return the largest power of ten, at most half of the interval, of which all times are multiples; 0 if there is
    none above 1e-9 of the interval."""
    largest = math.floor(math.log10(interval / 2))
    units = (10.0**power for power in range(largest, largest - 9, -1))
    return next((unit for unit in units if np.abs(times / unit - np.rint(times / unit)).max() < SAME), 0.0)


def _region(found: Tracks, settings: Settings) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """Return the lower and upper corner of the measured volume or the periodic box, in the coordinates of the file, the
    edge of the periodic cube, and the numbers (3,) of periods in it.

    A measured volume that is not periodic lies in the middle of a larger cube, at least [tracks] margin away from its
    periodic images. Along a short edge of the volume there is room for several images, so the flow has a shorter period
    and fewer modes. For filtered tracks, of which solves were no faster and less accurate, it has one period.
    """
    if settings.volume is None:
        edge = settings.box if settings.box is not None else found.edge
        if edge is None:
            raise SceneError("[tracks] box: this key is missing, and the file has no periodic cubic box; give "
                             'the edge of the periodic cube, or the volume of the measurement, such as volume = "auto"')
        if found.edge is not None and abs(edge - found.edge) > ROUNDING * edge:
            raise SceneError(f"[tracks] box = {edge:g}: {settings.file} has a periodic box of the edge {found.edge:g}; "
                             "remove box, or correct the file")
        lower = np.zeros(3) if found.lower is None else found.lower
        return lower, lower + edge, edge, np.ones(3, int)
    if found.edge is not None and (np.ptp(found.position, axis=0) <= found.edge * (1 + ROUNDING)).all() and not (
            _continuous(found, found.edge, 0.0)):
        raise SceneError(f"[tracks] volume: tracks of {settings.file} jump from face to face of its periodic box; "
                         "remove volume")
    if settings.volume == "auto":
        lower, upper = found.position.min(0), found.position.max(0)
        log.info("%s: volume = [%s]", settings.file, ", ".join(f"{x:.6g}" for x in np.ravel([lower, upper], "F")))
        if not (lower < upper).all():
            raise SceneError(f'[tracks] volume = "auto": {settings.file} has the same '
                             f"{'xyz'[int(np.argmin(upper - lower))]} in all rows; give volume as six numbers")
    else:
        lower, upper = np.reshape(settings.volume, (3, 2)).T
    edges, count = upper - lower, len(found.time) / len(found.times)
    spacing = (float(np.prod(edges)) / count) ** (1 / 3)
    if edges.min() < FLAT * spacing:
        raise SceneError(_flat(settings, edges, count))
    margin = MARGIN * spacing if settings.margin is None else settings.margin
    edge = float(edges.max()) + margin
    periods = np.ones(3) if settings.filtered else np.floor(edge / (edges + margin) * (1 + EQUAL))
    return lower, upper, edge, periods.astype(int)


def _flat(settings: Settings, edges: np.ndarray, count: float) -> str:
    """Return the refusal of a volume with these `edges` that is too thin for `count` tracks a frame. They then lie in a
    sheet: no derivative across it can be found, and cells of a cube as small as it is thin are too many."""
    thickness, axis = edges.min(), int(np.argmin(edges))
    least = FLAT**1.5 * math.sqrt(float(np.prod(np.delete(edges, axis))) / count)
    return (f"[tracks] volume: {settings.file}: it is {thickness:.3g} thick along {'xyz'[axis]}, too thin for fields "
            f"of {count:.0f} tracks a frame; give a volume that is at least {least:.2g} thick, or more tracks")
