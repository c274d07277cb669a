"""Ground truth of measured tracks: scales, velocities by splines, and fields by least squares."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch

from eddies.analysis.isotropic_turbulence import dissipation_constant
from eddies.analysis.track_splines import smooth
from eddies.flow.statistics import component_energies, energy_spectrum, gradient_moments, turbulence_scales
from eddies.io.fields import FieldWriter
from eddies.io.hdf5 import create_product, in_files, write_attributes, write_table
from eddies.io.track_files import check_box, read_tracks
from eddies.io.trajectories import TrajectoryWriter
from eddies.parallel.communicator import Comm
from eddies.parallel.migration import id_block, migrate
from eddies.parallel.slab import SlabDecomposition
from eddies.parallel.stop import StopRequest
from eddies.particles.flow_units import FlowUnits, ReferenceScales, measured_scales
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.particles.resolved_velocity import ResolvedFlow, ResolvedVelocity
from eddies.pipeline import STAGES
from eddies.scene.scene import BOX_LENGTH, Flow, Scene, SceneError, Tracers
from eddies.scene.sections import Eulerian, Tracks
from eddies.spectral.spectral_grid import SpectralGrid, regrid
from eddies.workflows.run_directory.fingerprints import stage_provenance

log = logging.getLogger("eddies")

UNEQUAL = 1e-3          # largest relative difference of two intervals between frames
LEAST_FRAMES, LEAST_TRACKS = 3, 8
INTEGRAL_SCALE = 0.2    # of the edge of the box: a guess, for estimates before the tracks are read
ROUNDS = 20             # of the fixed point for the dissipation rate, each three times closer


@dataclass(frozen=True)
class MeasuredTracks:
    """Tracks that are there in all frames, in the units of a scene: the edge of the box is 2 pi.

    Parameters
    ----------
    times : from 0 on, (frames,).
    columns : position and velocity (frames, tracks, 3), and density (frames, tracks) of a compressible fluid, in units
        of its mean.
    of_all : number of tracks in the file. smoothing : of the splines; None without splines.
    unit : of length, in that of the file.
    """

    times: np.ndarray
    columns: Mapping[str, np.ndarray]
    of_all: int
    smoothing: float | None
    unit: float

    @property
    def interval(self) -> float:
        return float((self.times[-1] - self.times[0]) / (len(self.times) - 1))


def with_tracks(scene: Scene, comm: Comm) -> Scene:
    """A scene with [tracks] and the sections [flow] and [tracers] that follow from its file; all ranks call it.

    Raises SceneError or ProductError if the tracks do not fit, or the scene has other such sections.
    """
    settings = scene.tracks
    for each in (scene, *scene.variant.values()):
        for problem in _unfit(each):
            raise SceneError(problem)
        if each.tracks != settings:
            raise SceneError(f'variant "{each.name}": all variants have the same tracks; change [tracks] for the whole '
                             "scene")
    found = in_files(comm, settings.file, lambda: _sections_of(settings))
    for name, own in found.items():
        if getattr(scene, name) not in (None, own):
            raise SceneError(f"[{name}]: does not fit [tracks], which takes the place of this section; remove it")
    return replace(scene, **found, variant={name: replace(each, **found) for name, each in scene.variant.items()})


def _unfit(scene: Scene) -> Iterator[str]:
    """Sections and terms of a scene that tracks cannot serve."""
    settings, model, simulation = scene.tracks, scene.model, scene.simulation
    for name in ("forcing", "spin_up"):
        if getattr(scene, name) is not None:
            yield f"[{name}]: [tracks] takes the place of this section; remove it"
    learned = [f"[{name}]" for name in ("kernel", "model", "simulation") if getattr(scene, name) is not None]
    if learned and not settings.filtered:
        yield (f"[tracks] filtered = false: models are those of a filtered velocity; remove {', '.join(learned)}, or "
               "set filtered = true if the tracks follow one")
    viscous = [name for name, term in model.settings.items() if term.viscous] if model else []
    if settings.viscosity is None and viscous:
        yield (f'[tracks] viscosity: this key is missing, and the term "{viscous[0]}" needs it; give it, or choose '
               "other terms")
    if simulation is not None and simulation.on_grid:
        if settings.viscosity is None:
            yield '[tracks] viscosity: this key is missing, and [simulation] method = "eulerian" needs it; give it'
        if (scene.eulerian or Eulerian()).start != "particles":
            yield ('[eulerian] start = "flow": the whole flow is not known where tracks are measured; set start = '
                   '"particles"')


def _sections_of(settings: Tracks) -> dict[str, Flow | Tracers]:
    tracks = measured(settings)
    velocity = tracks.columns["velocity"]
    count, speed = velocity.shape[1], float(np.sqrt(np.mean(velocity**2)))
    turnover = INTEGRAL_SCALE * BOX_LENGTH / speed if speed > 0 else math.inf
    width = None if settings.filter_width is None else settings.filter_width / tracks.unit
    tracers = Tracers(count=count, filtered=settings.filtered, frame_interval=tracks.interval, filter_width=width,
                      turnovers=max(float(tracks.times[-1] / turnover), 1e-6), field_every=settings.field_every)
    viscosity = 0.0 if settings.viscosity is None else settings.viscosity / tracks.unit**2
    cells, sound = max(tracers.cells, tracers.planes, 8), settings.sound_speed
    flow = Flow(fluid="incompressible", cells=cells, viscosity=viscosity) if sound is None else Flow(
        fluid="compressible", cells=cells, viscosity=viscosity, sound_speed=sound / tracks.unit)
    return {"flow": flow, "tracers": tracers}


def run(scene: Scene, comm: Comm, directory: str | Path, stop: StopRequest | None = None) -> None:
    """Write ground_truth.h5 of measured tracks; all ranks call it.

    Its filtered fields are those of the resolved velocity, which regularised least squares find in the velocities of
    the tracks. If the tracks follow the whole flow, the filter is applied to it. The dissipation rate is that of the
    literature for the measured velocity and integral scale (`dissipation_constant`).
    """
    settings, tracers = scene.tracks, scene.tracers
    times, about = in_files(comm, settings.file, lambda: _about(settings))
    tracks = measured(settings) if comm.rank == 0 else None  # only rank 0 holds them
    total, slab = tracers.particles, SlabDecomposition(comm, BOX_LENGTH, tracers.planes)

    def block(frame: int) -> dict[str, np.ndarray]:
        """The rows of this rank's block of ids at a frame."""
        start, stop = id_block(comm, total)
        bounds = comm.gather((start, stop))
        rows = None if tracks is None else [{name: values[frame, slice(*each)] for name, values in
                                             tracks.columns.items()} for each in bounds]
        return {"id": np.arange(start, stop), **comm.scatter(rows)}

    first, second = block(0), block(1)
    scales = measured_scales(comm, first, second, times[1] - times[0])
    reference = {"filter_width": tracers.filter_width, "spacing": tracers.spacing, "density_mean": 1.0,
                 "viscosity": scene.flow.viscosity, **scales}
    solver = _solver(slab, reference, 0.0)
    flow = Reconstruction(solver.of(_particles(slab, first)), first, tracers)
    reference = flow.scales(scene.flow.viscosity) | reference  # velocity_rms is that of the particles
    solver = _solver(slab, reference, reference["kolmogorov_length"])
    coarse = SpectralGrid(SlabDecomposition(comm, BOX_LENGTH, tracers.cells), cutoff=(tracers.cells - 1) // 2)
    sound = {"sound_speed": scene.flow.sound_speed or math.inf}
    if scene.flow.compressible:
        sound["mach_turbulent"] = math.sqrt(2 * flow.energy.sum()) / scene.flow.sound_speed
    with create_product(comm, Path(directory) / STAGES["dns"].file, "ground_truth",
                        stage_provenance(scene, "dns")) as file:
        shapes = {name: values.shape[1:] for name, values in first.items() if name != "id"}
        trajectory = TrajectoryWriter(file, "tracers", total, BOX_LENGTH, shapes, np.float64)
        fields = FieldWriter(file, "filtered", coarse.cells, {"velocity": 3})
        rows, spectra, near = [], [], None
        for frame, time in enumerate(times):
            if stop is not None:
                stop.check()
            columns = block(frame)
            trajectory.append(frame, time, id_block(comm, total)[0], columns)
            if frame % tracers.field_every:
                continue
            with torch.no_grad():
                flow = Reconstruction(solver.of(_particles(slab, columns), near=near), columns, tracers)
            near = flow.resolved.velocity
            planes = coarse.backward(regrid(flow.grid, coarse, flow.filtered)) + flow.mean[:, None, None, None]
            fields.append(time, coarse.decomposition.start, {"velocity": planes})
            row = flow.scales(scene.flow.viscosity) | {"time": time, "energy": flow.energy.sum()}
            skewness, flatness = gradient_moments(flow.grid, flow.filtered)
            rows.append(row | {"skewness": skewness, "flatness": flatness}
                        | component_energies(flow.grid, flow.filtered))
            spectra.append((time, flow.energy, flow.filtered_energy))
        write_attributes(file.create_group("reference"), {
            **reference, "released_at": 0.0, "energy": float(spectra[0][1].sum()), **sound})
        write_table(file, "statistics", {name: np.array([row[name] for row in rows]) for name in rows[0]})
        columns = dict(zip(("time", "energy", "filtered"), map(np.array, zip(*spectra))))
        write_table(file, "spectra", {"wavenumber": np.arange(columns["energy"].shape[1]), **columns})
        write_attributes(file.create_group("tracks"), about)
    log.info("dns: %d of %d tracks are there in all %d frames, over %.3g T; u' = %.3g, L = %.3g", total,
             about["in_file"], len(times), times[-1] / reference["eddy_turnover_time"], reference["velocity_rms"],
             reference["integral_scale"])


class Reconstruction:
    """The velocity field of one frame.

    Parameters
    ----------
    resolved : the result of least squares. columns : this rank's rows of the frame.
    tracers : says whether the particles follow the filtered velocity, and its filter.
    """

    def __init__(self, resolved: ResolvedFlow, columns: Mapping[str, np.ndarray], tracers: Tracers) -> None:
        self.resolved, self.grid = resolved, resolved.grid.spectral
        comm, velocity = self.grid.decomposition.comm, columns["velocity"]
        self.mean = comm.allreduce(velocity.sum(0)) / tracers.particles
        whole = resolved.unfiltered if tracers.filtered else resolved.velocity
        self.filtered = as_numpy(resolved.velocity if tracers.filtered else whole * resolved.filter_transfer)
        self.energy, self.filtered_energy = (energy_spectrum(self.grid, modes)[1]
                                             for modes in (as_numpy(whole), self.filtered))

    def scales(self, viscosity: float) -> dict[str, float]:
        """Scales of turbulence; eps = C_eps u'^3 / L, with C_eps and Re_lambda found together."""
        cutoff = self.resolved.grid.resolved
        found = turbulence_scales(self.energy, 0.0, 0.0, cutoff)
        speed, length = found["velocity_rms"], found["integral_scale"]
        rate, reynolds = 0.0, math.inf
        for _ in range(ROUNDS if length > 0 else 0):
            rate = dissipation_constant(reynolds) * speed**3 / length
            reynolds = math.sqrt(15 / (viscosity * rate)) * speed**2 if viscosity > 0 else math.inf
        return turbulence_scales(self.energy, rate, viscosity, cutoff) | {"dissipation_rate": rate}


def _about(settings: Tracks) -> tuple[np.ndarray, dict[str, str | float]]:
    tracks = measured(settings)
    return tracks.times, {"file": settings.path, "in_file": tracks.of_all, "length_unit": tracks.unit}


def measured(settings: Tracks) -> MeasuredTracks:
    """The tracks of a file that are there in all its frames; one rank calls it.

    Raises ProductError if the file is unfit, SceneError if too few tracks or frames remain.
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
    found = replace(found, time=found.time * settings.time_unit)
    check_box(found, edge, settings.file)
    frames = len(found.times)
    intervals = np.diff(found.times)
    if frames < LEAST_FRAMES:
        raise SceneError(f"{settings.file}: has {frames} frames; a model needs {LEAST_FRAMES}")
    if np.ptp(intervals) > UNEQUAL * intervals.mean():
        raise SceneError(f"{settings.file}: frames follow each other at intervals of {intervals.min():g} to "
                         f"{intervals.max():g}; models need equal ones")
    names, place, counts = np.unique(found.track, return_inverse=True, return_counts=True)
    throughout = counts == frames
    if throughout.sum() < LEAST_TRACKS:
        raise SceneError(f"{settings.file}: {throughout.sum()} of {len(names)} tracks are there in all {frames} "
                         f"frames, and a model needs {LEAST_TRACKS}; give a part of the file with fewer frames")
    found = found.chosen(throughout[place])
    position, velocity, smoothing = found.position, found.velocity, None
    if velocity is None or settings.noise > 0:
        splines = smooth(found.time, found.track, position, edge, settings.noise)
        order = np.argsort(splines.rows)
        smoothing, position, velocity = splines.smoothing, splines.position[order], splines.velocity[order]
    unit, shape = edge / BOX_LENGTH, (frames, -1, 3)
    columns = {"position": (position / unit % BOX_LENGTH).reshape(shape), "velocity": (velocity / unit).reshape(shape)}
    if settings.sound_speed is not None:
        if found.density is None:
            raise SceneError(f"[tracks] sound_speed = {settings.sound_speed:g}: {settings.file} has no densities; "
                             "remove the key")
        columns["density"] = (found.density / found.density.mean()).reshape(frames, -1)
    return MeasuredTracks(found.times - found.times[0], columns, len(names), smoothing, unit)


def _solver(slab: SlabDecomposition, reference: Mapping[str, float], kolmogorov_length: float) -> ResolvedVelocity:
    scales = ReferenceScales(
        filter_width=reference["filter_width"], spacing=reference["spacing"], velocity=reference["velocity_rms"],
        acceleration=reference["acceleration_rms"], density_mean=1.0, viscosity=reference["viscosity"],
        kolmogorov_length=kolmogorov_length)
    return ResolvedVelocity.on_slabs(slab, FlowUnits(scales, cutoff=0.0, neighbors=0.0))


def _particles(slab: SlabDecomposition, columns: Mapping[str, np.ndarray]) -> ParticleSet:
    return ParticleSet.from_numpy(migrate(slab, dict(columns)))
