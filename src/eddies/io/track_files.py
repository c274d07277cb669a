"""Particle tracks of experiments and other programs, read in six layouts and written in the first of them.

A track is the path of one particle. Tracks are kept as rows, one for each particle and time, sorted by time. Layouts:

- "h5md": H5MD 1.1 (de Buyl, Colberg & Höfling, Comput. Phys. Commun. 185, 1546), which eddies uses for trajectories.
  /particles/GROUP holds `position`, `velocity` and `id`. An id below 0 marks a row without a particle.
- "npz": NumPy arrays `pos` and `vel` (frames, particles, 3) and `rho` (frames, particles), as published with Tian et
  al. (2023). The file may also have the times of the frames, `time` (frames,).
- "lagrangebench": TRAJECTORY/position (frames, particles, 3) and metadata.json beside the file (Toshev et al. 2023).
- "flowtracks": rows with `trajid`, `time`, `pos` and `vel` or `velocity`, in the group or table /trajectories or
  /particles.
- "proptv": NetCDF-3 files, one for each frame, as the flows from which proPTV makes its test data: `particles`
  (particles, 8) holds z, y, x, w, v, u, temperature and pressure, and `tprobl` the time.
- "csv": a table, or a series of tables, as tracking programs write them (io/track_tables.py).
"""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import h5py
import numpy as np

from eddies.io.errors import ProductError, read_errors
from eddies.io.file_patterns import matching_files
from eddies.io.new_files import create_export
from eddies.io.track_tables import is_table, read_point_table, read_table
from eddies.io.trajectories import ROUNDING, write_h5md_header

SUFFIXES = {".npz": "npz", ".nc": "proptv", **dict.fromkeys((".csv", ".txt", ".dat", ".tsv"), "csv")}
TIMED = ("h5md", "lagrangebench", "proptv")   # layouts whose frames have times
GROUPED = ("h5md", "lagrangebench")     # layouts with groups of particles or trajectories
METADATA = "metadata.json"              # file beside those of LagrangeBench
ROWS = ("trajectories", "particles")    # groups or tables of flowtracks
FILL = -1  # the id of a row without a particle
MOST_ID = 2**53  # larger ids are not exact in double precision
OFF = 5.0  # largest error of a coordinate, in standard deviations
MOST_OFF = 2.0  # if displacement and velocity * interval differ by a larger factor, their units are wrong
# If their difference is larger than this fraction of the displacement, components are wrong. The median is 0.88 if two
# components of isotropic velocities are swapped or one has the wrong sign; noise of positions makes it 0.8 if it
# changes displacements by 1.3 times their size.
MOST_ASIDE = 0.8


@dataclass(frozen=True)
class Tracks:
    """Rows of tracks, sorted by time and then by id.

    Parameters
    ----------
    time, track : time and track id of each row, (rows,).
    position, velocity, density : (rows, 3), (rows, 3) and (rows,). The last two are None if they were not measured.
    edge : edge of the periodic cube; None if the file gives none. lower : its lower corner (3,); None for the origin.
    """

    time: np.ndarray
    track: np.ndarray
    position: np.ndarray
    velocity: np.ndarray | None = None
    density: np.ndarray | None = None
    edge: float | None = None
    lower: np.ndarray | None = None

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """The columns that were measured, by name."""
        found = {name: getattr(self, name) for name in ("time", "track", "position", "velocity", "density")}
        return {name: values for name, values in found.items() if values is not None}

    def chosen(self, rows: np.ndarray) -> Tracks:
        """Return the tracks with these rows only; `rows` holds row numbers or a boolean mask."""
        return replace(self, **{name: values[rows] for name, values in self.columns.items()})

    @cached_property
    def times(self) -> np.ndarray:
        """Time of each frame, (frames,)."""
        return np.unique(self.time)

    @cached_property
    def starts(self) -> np.ndarray:
        """First row of each frame and, at the end, the number of rows, (frames + 1,)."""
        return np.append(np.searchsorted(self.time, self.times), len(self.time))


def read_tracks(path: str | Path, layout: str | None = None, group: str | None = None,
                frame_rate: float | None = None, columns: Mapping[str, str | int] | None = None) -> Tracks:
    """Read the tracks of a file, or of a series of tables.

    Parameters
    ----------
    path : path of the file. In that of a series of tables * stands for any text.
    layout : one of LAYOUTS; None to find it by the name and content of the file.
    group : name of the group of particles (H5MD) or of the trajectory (LagrangeBench); needed if the file has several.
    frame_rate : frames per unit of time, for a table that counts frames, and for an NPZ file without times.
    columns : name or number of columns of a table, by track, time, x, y, z, u, v, w; numbers count from 1. Columns that
        are not given are recognised by their names, or by those that tracking programs write.

    Raises:
        ProductError: the file is missing or cannot be read, has another layout, lacks values, holds values that are
            not finite, or holds a track twice at one time.
    """
    path = Path(path)
    files = matching_files(path)
    if not files:
        raise ProductError(f"{path}: no such file; give the path of a file with particle tracks")
    try:
        with read_errors(path):
            layout = layout or _layout_of(max(files, key=lambda file: file.stat().st_size))
            if layout not in LAYOUTS:
                raise ProductError(f"{path}: layout = {layout!r}: must be one of {', '.join(LAYOUTS)}")
            if frame_rate is not None and not 0 < frame_rate < math.inf:
                raise ProductError(f"{path}: frame_rate = {frame_rate}: must be a positive number; give the frames per "
                                   "unit of time")
            if group is not None and layout not in GROUPED:
                raise ProductError(f"{path}: has the layout {layout}, without groups; remove group")
            if layout == "csv":
                found = Tracks(*read_table(path, columns, frame_rate))
            elif len(files) > 1 and layout != "proptv":
                raise ProductError(f"{path}: names {len(files)} files, but only tables may be several; give one file")
            elif columns:
                raise ProductError(f"{path}: has the layout {layout}; columns is for tables only, remove it")
            elif frame_rate is not None and layout in TIMED:
                raise ProductError(f"{path}: has the layout {layout}, whose frames have times; remove frame_rate")
            elif layout == "proptv":
                found = _read_proptv(files)
            else:
                found = READERS[layout](files[0], group, frame_rate)
    except UNREADABLE as error:
        text = " ".join(str(error.args[0] if error.args else error).split())
        raise ProductError(f"{path}: cannot be read as {layout}: {text}") from None
    return checked(found, path)


def read_points(path: Path) -> tuple[np.ndarray | None, np.ndarray]:
    """Read the points of a table with the columns x, y, z and, if it has times, `time`.

    Returns time (rows,) or None, and position (rows, 3). Raises ProductError if the file is missing or has no such
    rows.
    """
    try:
        with read_errors(path):
            return read_point_table(path)
    except UNREADABLE as error:
        raise ProductError(f"{path}: cannot be read as a table of points: {' '.join(str(error).split())}") from None


def write_tracks(path: str | Path, times: Any, ids: Any, positions: Any, velocities: Any = None,
                 edge: float = 2 * math.pi) -> None:
    """Write tracks as an H5MD file, which `read_tracks` and the section [tracks] of a scene can read.

    Parameters
    ----------
    times, ids : time and track id of each row, (rows,). Ids are at least 0.
    positions, velocities : (rows, 3); velocities may be None.
    edge : edge of the periodic cube.

    Rows with a masked value are left out.

    Raises:
        ProductError: a value is not finite, the edge is not positive, the arrays have different numbers of rows, a
            track appears twice at one time, or the file cannot be written.
    """
    path = Path(path)
    if not 0 < edge < math.inf:
        raise ProductError(f"{path}: edge = {edge}: must be a positive number; give the edge of the periodic cube")
    given = {"time": times, "track": ids, "position": positions, "velocity": velocities}
    tracks = Tracks(edge=float(edge), **{
        name: None if values is None else np.asarray(values, None if name == "track" else float)
        for name, values in given.items()})
    masks = [np.ma.getmaskarray(values) for values in given.values() if np.ma.is_masked(values)]
    if masks:
        tracks = tracks.chosen(~np.any([mask.reshape(len(mask), -1).any(1) for mask in masks], axis=0))
    tracks = checked(tracks, path)
    rows = tracks.starts[1:] - tracks.starts[:-1]
    frames, most = len(rows), int(rows.max())
    frame = np.repeat(np.arange(frames), rows)
    column = np.arange(len(frame)) - np.repeat(tracks.starts[:-1], rows)
    values = {"id": tracks.track, "position": tracks.position, "velocity": tracks.velocity}
    layout = {f"particles/tracks/{name}/value": ((frames, most, *given.shape[1:]), given.dtype)
              for name, given in values.items() if given is not None}
    with create_export(path, layout, {}) as file:
        write_h5md_header(file)
        holder = file["particles/tracks"]
        holder.create_group("box").attrs.update({"dimension": 3, "boundary": np.array([b"periodic"] * 3)})
        holder["box/edges"] = np.full(3, tracks.edge)
        for name, given in values.items():
            if given is not None:
                padded = np.full((frames, most, *given.shape[1:]), FILL if name == "id" else 0, given.dtype)
                padded[frame, column] = given
                holder[f"{name}/value"][:] = padded
                holder[f"{name}/step"], holder[f"{name}/time"] = np.arange(frames), tracks.times


# ---- layouts


def _layout_of(path: Path) -> str:
    """Return the layout that the suffix of a file shows, or its content: that of an HDF5 file, or of a text that begins
    as a table."""
    suffix = path.suffix.lower()
    if suffix in SUFFIXES:
        return SUFFIXES[suffix]
    if suffix in (".h5", ".hdf5", ".h5md") or h5py.is_hdf5(path):
        with h5py.File(path) as file:
            if "particles" in file and isinstance(file["particles"], h5py.Group):
                return "h5md"
            if (path.parent / METADATA).is_file():
                return "lagrangebench"
            if any(name in file for name in ROWS):
                return "flowtracks"
            raise ProductError(f"{path}: holds {', '.join(file) or 'nothing'}, but no particles/GROUP/position (H5MD), "
                               f"no {' or '.join(ROWS)} (flowtracks), and there is no {METADATA} beside it "
                               "(LagrangeBench); write the tracks as a table, or by eddies.write_tracks")
    if is_table(path):
        return "csv"
    raise ProductError(f"{path}: the suffix does not show the layout; give the format (in Python: layout), one of "
                       f"{', '.join(LAYOUTS)}")


def _read_h5md(path: Path, group: str | None, frame_rate: float | None) -> Tracks:
    with h5py.File(path) as file:
        holder = _chosen(path, file.get("particles", {}), group, "groups of particles")
        element = holder["position"]
        position = element["value"][()]
        time = element["time"]
        times = time[()] if time.shape else float(time.attrs.get("offset", 0.0)) + time[()] * np.arange(len(position))
        velocity, density = (holder[f"{name}/value"][()] if f"{name}/value" in holder else None
                             for name in ("velocity", "density"))
        ids = next((holder[key][()] for key in ("id", "id/value") if isinstance(holder.get(key), h5py.Dataset)), None)
        edges = _edges_of(holder["box"]) if "box" in holder else []
    return _from_frames(times, position, velocity, density, edges, ids)


def _edges_of(box: h5py.Group) -> np.ndarray:
    """Return the different edges of an H5MD box; none if it has none or is not periodic. Raises ValueError if the box
    changes in time or has edges that are not along the axes."""
    held = [box[name] for name in ("edges", "edges/value") if isinstance(box.get(name), h5py.Dataset)]
    if not held or any(mark in ("none", b"none") for mark in box.attrs.get("boundary", ())):
        return np.zeros(0)
    [dataset], edges, remedy = held, held[0][()], "give tracks in a constant box with edges along the axes"
    if dataset.name.endswith("/value"):
        changed = np.flatnonzero(~np.isclose(edges, edges[0], ROUNDING, 0.0).reshape(len(edges), -1).all(1))
        if len(changed):
            raise ValueError(f"{dataset.name}: the box changes in time, first in frame {changed[0]}; {remedy}")
        edges = edges[0]
    if edges.ndim == 2:
        if np.abs(edges - np.diag(np.diag(edges))).max() > ROUNDING * np.abs(edges).max():
            raise ValueError(f"{dataset.name}: the box is triclinic; {remedy}")
        edges = np.diag(edges)
    return np.unique(edges)


def _read_npz(path: Path, group: str | None, frame_rate: float | None) -> Tracks:
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    if "pos" not in arrays:
        raise ValueError(f"it holds {', '.join(arrays) or 'nothing'}, but no array pos (frames, particles, 3)")
    if frame_rate is not None and "time" in arrays:
        raise ValueError("it holds an array time; remove frame_rate")
    times = arrays.get("time", None if frame_rate is None else np.arange(len(arrays["pos"])) / frame_rate)
    if times is None:
        raise ValueError("it holds no array time; give frame_rate, the frames per unit of time")
    return _from_frames(times, arrays["pos"], arrays.get("vel"), arrays.get("rho"))


def _read_lagrangebench(path: Path, group: str | None, frame_rate: float | None) -> Tracks:
    metadata = json.loads((path.parent / METADATA).read_text(encoding="utf-8"))
    with h5py.File(path) as file:
        holder = _chosen(path, file, group, "trajectories")
        position, types = holder["position"][()], np.unique(holder.get("particle_type", ()))
    if len(types) > 1:
        raise ValueError(f"particle_type has the types {', '.join(map(str, types))}, such as fluid and walls; give the "
                         "tracks of the fluid as a table")
    if not np.all(metadata.get("periodic_boundary_conditions", True)):
        raise ValueError(f"{METADATA}: periodic_boundary_conditions has false, but the box is read as a periodic cube; "
                         "give the tracks as a table, with volume")
    lower, upper = np.transpose(metadata["bounds"])
    times = float(metadata["dt"]) * int(metadata.get("write_every", 1)) * np.arange(len(position))
    return replace(_from_frames(times, position, edges=np.unique(upper - lower)), lower=lower)


def _read_flowtracks(path: Path, group: str | None, frame_rate: float | None) -> Tracks:
    with h5py.File(path) as file:
        rows = file[next(name for name in ROWS if name in file)]
        names = list(rows) if isinstance(rows, h5py.Group) else rows.dtype.names
        velocity = next((name for name in ("vel", "velocity") if name in names), None)
        found = Tracks(*(None if name is None else rows[name][()].astype(float)
                         for name in ("time", "trajid", "pos", velocity)))
    return found if frame_rate is None else replace(found, time=found.time / frame_rate)


def _read_proptv(files: Sequence[Path]) -> Tracks:
    from scipy.io import netcdf_file  # here, because the import is slow
    times, frames = [], []
    for path in files:
        with netcdf_file(path, mmap=False) as file:
            if not {"particles", "tprobl"} <= {*file.variables}:
                raise ValueError(f"{path.name} holds {', '.join(file.variables) or 'nothing'}, but particles and "
                                 "tprobl are needed")
            times.append(float(file.variables["tprobl"].getValue()))
            frames.append(np.array(file.variables["particles"].data, float))
    table = np.stack([frames[number] for number in np.argsort(times)])
    return _from_frames(np.sort(times), table[..., 2::-1], table[..., 5:2:-1])


READERS: Mapping[str, Callable[[Path, str | None, float | None], Tracks]] = {
    "h5md": _read_h5md, "npz": _read_npz, "lagrangebench": _read_lagrangebench, "flowtracks": _read_flowtracks}
LAYOUTS = (*READERS, "proptv", "csv")  # the last two may be several files
# Errors that numpy, h5py and json raise for a file whose content does not fit the layout.
UNREADABLE = (KeyError, ValueError, TypeError, IndexError, AttributeError, EOFError, BadZipFile, zlib.error)


def _chosen(path: Path, holder: Mapping[str, Any], name: str | None, what: str) -> Any:
    """Return the group `name` of `holder`, or its only group if `name` is None. Raises ProductError if there is no such
    group; `what` says in the message what the groups are."""
    if name is None and len(holder) == 1:
        return next(iter(holder.values()))
    if name is not None and name in holder:
        return holder[name]
    listed = ", ".join(list(holder)[:9]) or "none"
    raise ProductError(f"{path}: group = {name!r}: the file has these {what}: {listed}; give one of them as group")


def _from_frames(times: np.ndarray, position: np.ndarray, velocity: np.ndarray | None = None,
                 density: np.ndarray | None = None, edges: Sequence[float] = (),
                 ids: np.ndarray | None = None) -> Tracks:
    """Return tracks from arrays (frames, particles, ...) and `times` (frames,). Entries with an id below 0 are left
    out. `ids` is (frames, particles), (particles,) for the same ids in all frames, or None for the ids 0, 1, ...
    `edges` holds the different edges of the box; with a single one, the box is a cube."""
    if position.ndim != 3 or position.shape[2] != 3:
        raise ValueError(f"positions have the shape {position.shape}, not (frames, particles, 3)")
    ids = np.broadcast_to(np.arange(position.shape[1]) if ids is None else ids, position.shape[:2])
    edge = float(edges[0]) if len(edges) == 1 else None
    if edge is not None and not 0 < edge < math.inf:
        raise ValueError(f"its box has the edge {edge:g}, which must be a positive number; correct the box")
    for name, values, shape in (("times", times, position.shape[:1]), ("velocities", velocity, position.shape),
                                ("densities", density, position.shape[:2])):
        if values is not None and np.shape(values) != shape:
            raise ValueError(f"{name} have the shape {np.shape(values)}, but positions {position.shape}")
    if np.any(np.diff(times) <= 0):
        frame = int(np.argmax(np.diff(times) <= 0))
        raise ValueError(f"times must increase, but frame {frame + 1} is at {times[frame + 1]:g} after "
                         f"{times[frame]:g}")
    there = ids >= 0
    return Tracks(np.repeat(times, there.sum(1)).astype(float), ids[there], position[there].astype(float),
                  None if velocity is None else velocity[there].astype(float),
                  None if density is None else density[there].astype(float), edge)


# ---- checks


def checked(tracks: Tracks, path: Path) -> Tracks:
    """Return the tracks sorted by time and id, with ids of 64 bits. Raises ProductError if there is no row, or if a row
    is not valid."""
    rows = len(tracks.time)
    if not rows:
        raise ProductError(f"{path}: holds no particles")
    for name, values in tracks.columns.items():
        shape = (rows, 3) if name in ("position", "velocity") else (rows,)
        if values.shape != shape:
            raise ProductError(f"{path}: {name} has the shape {values.shape}, but {rows} times need {shape}")
        bad = np.flatnonzero(~np.isfinite(values).reshape(rows, -1).all(1))
        if len(bad):
            raise ProductError(f"{path}: {name} of track {tracks.track[bad[0]]} at time {tracks.time[bad[0]]:g} is not "
                               f"finite ({len(bad)} such rows); leave these rows out")
    bad = np.flatnonzero((tracks.track != np.rint(tracks.track)) | (tracks.track < 0) | (tracks.track >= MOST_ID))
    if len(bad):
        raise ProductError(f"{path}: track {tracks.track[bad[0]]} at time {tracks.time[bad[0]]:g}: ids must be whole "
                           f"numbers from 0 to 2^53 ({len(bad)} such rows); number the tracks again")
    tracks = replace(tracks, track=tracks.track.astype(np.int64))
    sorted_tracks = tracks.chosen(np.lexsort((tracks.track, tracks.time)))
    time, track = sorted_tracks.time, sorted_tracks.track
    twice = np.flatnonzero((np.diff(time) == 0) & (np.diff(track) == 0))
    if len(twice):
        raise ProductError(f"{path}: track {track[twice[0]]} appears twice at time {time[twice[0]]:g} ({len(twice)} "
                           "such rows); give each particle an id of its own")
    return sorted_tracks


def check_inside(tracks: Tracks, lower: np.ndarray, upper: np.ndarray, key: str, path: str | Path,
                 noise: float = 0.0) -> None:
    """Raise ProductError if positions are outside the region from `lower` to `upper` by more than their noise.

    The region or the unit of length is then wrong. `key` is the scene key that gives the region, "box" or "volume".
    `noise` is the standard deviation of the error of a coordinate.
    """
    margin = ROUNDING * (upper - lower) + OFF * noise
    outside = np.flatnonzero(((tracks.position < lower - margin) | (tracks.position > upper + margin)).any(1))
    if len(outside):
        row, (place, low, high) = outside[0], (", ".join(f"{x:.4g}" for x in point) for point in (
            tracks.position[outside[0]], lower, upper))
        raise ProductError(f"{path}: track {tracks.track[row]} at time {tracks.time[row]:g} is at ({place}), outside "
                           f"the {key} from ({low}) to ({high}) ({len(outside)} such rows); correct {key} or the unit "
                           "of length")


def check_velocities(tracks: Tracks, edge: float | None, path: str | Path) -> None:
    """Raise ProductError if the displacements between frames, by positions and by velocities, contradict each other.

    Their medians differ by the factor MOST_OFF or more, so a unit or the box is wrong; or the median of their
    difference exceeds the fraction MOST_ASIDE, so components are wrong. Those within the rounding of positions do not
    count. `edge` is the edge of the periodic cube, or None.
    """
    order = np.lexsort((tracks.time, tracks.track))
    same = tracks.track[order[1:]] == tracks.track[order[:-1]]
    first, second = order[:-1][same], order[1:][same]  # successive rows of a track
    if tracks.velocity is None or not len(first):
        return
    moved = tracks.position[second] - tracks.position[first]
    if edge is not None:
        moved -= edge * np.rint(moved / edge)
    interval = tracks.time[second] - tracks.time[first]
    said = (tracks.velocity[first] + tracks.velocity[second]) / 2 * interval[:, None]
    measured, given, aside = (float(np.median(np.linalg.norm(each, axis=1))) for each in (moved, said, moved - said))
    if max(measured, given) <= ROUNDING * (float(np.ptp(tracks.position)) if edge is None else edge):
        return
    if not given / MOST_OFF < measured < given * MOST_OFF:
        raise ProductError(f"{path}: particles move by {measured:.3g} between frames (median), but their velocities "
                           f"say {given:.3g}; correct time_unit, the box, or the unit of the velocities, or leave the "
                           "velocities out")
    if aside > MOST_ASIDE * measured:
        raise ProductError(f"{path}: particles move by {measured:.3g} between frames (median), but their velocities "
                           f"differ from that by {aside:.3g}; correct their order, signs or unit, or set "
                           'noise = "auto", so that splines of the positions take their place')
