"""Errors at tracks that are left out: of least squares and a memory, beside kriging and Delaunay interpolation."""

import logging
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from eddies.clock import ProgressLine
from eddies.io.hdf5 import File
from eddies.parallel.broadcast import on_first_rank
from eddies.parallel.communicator import Comm
from eddies.parallel.slab import SlabDecomposition
from eddies.parallel.stop import Stopped, StopRequest
from eddies.particles.particle_field import Form, ParticleField
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.particles.smoothing_kernels import CubicSpline
from eddies.scene.scene import BOX_LENGTH, Scene, Tracers
from eddies.scene.sections import NEIGHBORS
from eddies.workflows.track_solver import solving_method, split
from eddies.workflows.track_source import Source

log = logging.getLogger("eddies")

MOST_RADIUS = 0.499 * BOX_LENGTH    # of a kernel: a particle must have one image within it
FRAMES = 30          # most frames that methods with a memory see, which gains for 20; errors are of the second half
LEAST_TRACKS = 2     # smallest number of tracks that are left out
MOST_TRACKS = 1e5    # largest number of tracks of a frame that are compared: one rank triangulates all of them
IMAGES = 2.5         # thickness of the layer of periodic images around a box for the triangulation, in mean spacings

Rows = dict[str, np.ndarray]


def kernel_of(tracers: Tracers) -> CubicSpline:
    """Return the kernel whose support holds the particles of an estimate from neighbours."""
    return CubicSpline(min(tracers.radius_of(NEIGHBORS), MOST_RADIUS))


def errors_at_left_out(scene: Scene, source: Source, file: File, stop: StopRequest) -> dict[str, float]:
    """Return the velocity error of each method at the tracks that [reconstruction] holdout leaves out; collective.

    Methods are "least-squares", "memory" if the viscosity is known and there is no background, "kriging" among
    neighbours, and "delaunay", linear interpolation in the tetrahedra of the tracks that are kept. The error is |v -
    v_i| / |v'_i| over the left-out tracks that lie in a tetrahedron, and the mean over the second half of the first
    FRAMES frames. `tracks` is their mean number, and `floor` the error of the true velocity, if splines estimate the
    noise of the measured ones. The result is empty for more than MOST_TRACKS tracks, or if fewer than LEAST_TRACKS are
    left out. `source` belongs to the method of the scene, and `file` is the ground truth. Raises Stopped on request.
    """
    settings, comm = scene.reconstruction, source.slab.comm
    frames = range(0, len(source.times), settings.every)[:FRAMES]
    late = frames[len(frames) // 2:]
    forecasts = scene.flow.viscosity > 0 and source.background is None
    methods = ("least-squares", "memory") if forecasts else ("least-squares",)
    if source.most > MOST_TRACKS:
        log.info("reconstruct: more than %d tracks; methods are not compared at tracks that are left out", MOST_TRACKS)
        return {}
    found = []
    for method in methods:
        own = replace(settings, method=method)
        same = own.resolving(scene.tracers, source.filtered) == settings.resolving(scene.tracers, source.filtered)
        apart = _by_modes(replace(scene, reconstruction=own),
                          source if same else Source(scene.tracks, scene.tracers, own, file, comm), frames, late, stop)
        found.append(list(apart))
    known = [_gathered(comm, split(source.particles(frame), settings.holdout)[0]) for frame in late]
    alone = comm.Split(comm.rank)
    try:
        return on_first_rank(comm, lambda: _errors(scene, source, late, known, dict(zip(methods, found)), alone))
    finally:
        alone.Free()


def _by_modes(scene: Scene, source: Source, frames: range, late: range, stop: StopRequest) -> Iterator[Rows]:
    """Yield for the `late` frames, on rank 0, the rows of the tracks that are left out, with the `estimate` of their
    velocity; collective."""
    settings, comm = scene.reconstruction, source.slab.comm
    solver, weight, transfer = source.fitted(settings.holdout)
    method = solving_method(settings, solver, scene.flow.viscosity, transfer, weight)
    progress = _progress(settings.method)
    for number, frame in enumerate(frames, 1):
        if stop():
            raise Stopped(stop.reason, "continues after the last frame")
        known, apart = split(source.particles(frame), settings.holdout)
        modes = method.of(known, float(source.times[frame]))
        progress(number / len(frames), number)
        if frame in late:
            with torch.no_grad():
                estimate = solver.grid.at(modes, solver.grid.points(apart.position))
            yield _gathered(comm, apart, estimate=as_numpy(estimate))


def _progress(method: str) -> ProgressLine:
    return ProgressLine("reconstruct", lambda: f"{method} for left-out tracks", unit="frame")


def _gathered(comm: Comm, particles: ParticleSet, **columns: np.ndarray) -> Rows:
    """Return the rows of all ranks on rank 0, sorted by id; those of other ranks are empty."""
    columns |= {name: as_numpy(getattr(particles, name)) for name in ("id", "position", "velocity")}
    parts = comm.gather(columns) or [{name: values[:0] for name, values in columns.items()}]
    whole = {name: np.concatenate([part[name] for part in parts]) for name in columns}
    order = np.argsort(whole["id"])
    return {name: values[order] for name, values in whole.items()}


def _errors(scene: Scene, source: Source, frames: range, kept: list[Rows], found: dict[str, list[Rows]],
            alone: Comm) -> dict[str, float]:
    """Return the errors of all methods. For each of `frames`, `kept` has the tracks that are kept, and `found`, by
    method, the results of `_by_modes`."""
    slab = SlabDecomposition(alone, BOX_LENGTH, source.slab.planes)
    form = Form("kriging", kernel_of(scene.tracers), scene.tracers.filter_width)
    rows: list[dict[str, float]] = []
    progress = _progress("neighbours")
    for number, (frame, known, *each) in enumerate(zip(frames, kept, *found.values()), 1):
        apart = each[0]
        if len(apart["id"]) < LEAST_TRACKS:
            continue
        given = {name: torch.from_numpy(known[name]) for name in ("position", "velocity")}
        estimates = {name: rows_of["estimate"] for name, rows_of in zip(found, each)}
        estimates["kriging"] = as_numpy(form.at(ParticleField(slab, form.support, **given),
                                                torch.from_numpy(apart["position"]))[0])
        estimates["delaunay"] = interpolated(known, apart["position"], source.spacing if source.periodic else 0.0)
        inside = np.isfinite(estimates["delaunay"]).all(1)
        inside = inside if inside.any() else ~inside
        exact = apart["velocity"][inside]
        size = np.linalg.norm(exact - exact.mean(0))
        missed = {name: float(np.linalg.norm(values[inside] - exact)) for name, values in estimates.items()}
        if source.velocity_errors[frame, 0] > 0:
            missed["floor"] = source.velocity_errors[frame, 0] * np.sqrt(exact.size)
        rows.append({"tracks": float(len(exact)), **{
            name: float(value / size) if size > 0 else np.nan for name, value in missed.items()}})
        progress(number / len(kept), number)
    means = {name: float(np.mean([row[name] for row in rows])) for name in (rows[0] if rows else ())}
    return {name: value for name, value in means.items() if np.isfinite(value)}


def interpolated(known: Rows, points: np.ndarray, spacing: float) -> np.ndarray:
    """Return the velocity (n, 3) at points (n, 3) by linear interpolation in the Delaunay tetrahedra of particles.

    `known` holds their `position` and `velocity`, and `spacing` is their mean distance if the box is periodic, else 0.
    The result is NaN outside the tetrahedra, and everywhere if the particles span no volume.
    """
    from scipy.interpolate import LinearNDInterpolator  # here, because the imports are slow
    from scipy.spatial import QhullError
    position, velocity = known["position"], known["velocity"]
    for axis in np.eye(3):
        place = position @ axis
        low, high = np.flatnonzero(place < IMAGES * spacing), np.flatnonzero(place > BOX_LENGTH - IMAGES * spacing)
        position = np.concatenate([position, position[low] + BOX_LENGTH * axis, position[high] - BOX_LENGTH * axis])
        velocity = np.concatenate([velocity, velocity[low], velocity[high]])
    try:
        return LinearNDInterpolator(position, velocity)(points)
    except (QhullError, ValueError):
        return np.full(points.shape, np.nan)
