"""Make the ground truth of measured tracks: scales, velocities by splines, and fields by least squares."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from eddies.analysis.errors import fluctuations
from eddies.analysis.isotropic_turbulence import dissipation_constant
from eddies.clock import ProgressLine
from eddies.flow.history import UNITS
from eddies.flow.statistics import component_energies, energy_spectrum, gradient_moments, turbulence_scales
from eddies.io.fields import FieldWriter
from eddies.io.hdf5 import File, Table, create_product, in_files, write_table
from eddies.io.new_files import set_attributes
from eddies.io.trajectories import TrajectoryWriter
from eddies.parallel.communicator import Comm
from eddies.parallel.migration import IdOrder, id_block, migrate
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.parallel.stop import StopRequest
from eddies.particles.flow_units import measured_scales, planes_for
from eddies.particles.fourier_grid import FourierGrid
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.pipeline import STAGES
from eddies.scene.scene import BOX_LENGTH, Flow, Scene, SceneError, Tracers
from eddies.scene.sections import Eulerian, Initial, Reconstruction, Tracks
from eddies.spectral.spectral_grid import SpectralGrid, regrid
from eddies.workflows.ground_truth.flow_run import write_spectra
from eddies.workflows.ground_truth.track_frames import TrackFrames, count_for, read_measured, surest
from eddies.workflows.run_directory.fingerprints import stage_provenance
from eddies.workflows.track_solver import (NO_FILTER, LeastSquaresMethod, UniformMethod, best_solver, particles_on,
                                           slabs_for, solver_of, solving_method)

log = logging.getLogger("eddies")

LEAST_TRACKS = 8        # least number of tracks that a model needs
LEAST_CELLS = 10        # [flow] cells for few tracks; with fewer, checks of [initial], which is not used, fail
INTEGRAL_SCALE = 0.2    # integral scale divided by the edge of the box: a guess, for estimates before the run
ROUNDS = 20             # iterations for the dissipation rate; each reduces the error to a third

Columns = dict[str, np.ndarray]


def with_tracks(scene: Scene, comm: Comm) -> Scene:
    """Return a scene with the sections [flow] and [tracers] that follow from the file of [tracks]; all ranks call it.

    Raises SceneError or ProductError if the tracks do not fit, or if the scene has these sections with other values.
    """
    settings = scene.tracks
    for name, each in {"": scene, **scene.variant}.items():
        if each.tracks != settings:
            raise SceneError(f'variant "{name}": all variants must have the same tracks; set [tracks] for the whole '
                             "scene")
        for section, default in (("initial", Initial()), ("forcing", None), ("spin_up", None)):
            if getattr(each, section) != default:
                raise SceneError(f"[{section}]: [tracks] takes the place of this section; remove [{section}]")
        if each.realisations is not None:
            raise SceneError(f"realisations = {[*each.realisations]}: the file has one realisation; remove the key, "
                             "and write a scene for each file")
        for problem in _unfit(each):
            raise SceneError(problem)
    learned = any(part is not None for part in (scene.kernel, scene.model, scene.simulation))
    found = in_files(comm, settings.file, lambda: _sections_of(settings, learned))
    for name, own in found.items():
        if getattr(scene, name) not in (None, own):
            raise SceneError(f"[{name}]: does not fit [tracks], which takes the place of this section; remove it, or "
                             f"add --unset {' --unset '.join(found)} if the scene is the scene.toml of a run")
    return replace(scene, **found, variant={name: replace(each, **found) for name, each in scene.variant.items()})


def _unfit(scene: Scene) -> Iterator[str]:
    """Yield a message for each setting of a scene that cannot be used with tracks."""
    settings, wanted, model, simulation = scene.tracks, scene.reconstruction, scene.model, scene.simulation
    learned = [f"[{section}]" for section in ("kernel", "model", "simulation") if getattr(scene, section) is not None]
    if wanted is not None:
        if settings.viscosity is None and {"memory", "acceleration", "dissipation"} & {wanted.method, *wanted.fields}:
            yield ("[tracks] viscosity: this key is missing, and the method memory, the acceleration and the "
                   "dissipation need it; give it, or change [reconstruction]")
        if settings.volume is not None and wanted.of_neighbors:
            yield (f'[reconstruction] method = "{wanted.method}": its points need particles on all sides, which a '
                   'volume that is not periodic lacks; set method = "least-squares" or "memory"')
        if settings.background != "none" and wanted.method == "memory":
            yield (f'[tracks] background = "{settings.background}": forecasts of the method "memory" have no mean '
                   'shear; set [reconstruction] method = "least-squares", or remove background')
    if learned and not settings.filtered and settings.sound_speed is not None:
        yield (f"[tracks] sound_speed = {settings.sound_speed:g}: the density of the unfiltered flow is no filtered "
               f"density, which models need; remove sound_speed, or {', '.join(learned)}")
    if learned and settings.volume is not None:
        yield (f"[tracks] volume: models need particles in the whole periodic cube; remove {', '.join(learned)}, or "
               "give box if the flow is periodic")
    viscous = [name for name, term in model.settings.items() if term.viscous] if model else []
    if settings.viscosity is None and viscous:
        yield (f'[tracks] viscosity: this key is missing, and the term "{viscous[0]}" needs it; give it, or choose '
               "other terms")
    if simulation is not None and simulation.form.on_grid:
        if settings.viscosity is None:
            yield '[tracks] viscosity: this key is missing, and [simulation] method = "eulerian" needs it; give it'
        if (scene.eulerian or Eulerian()).start != "particles":
            yield ('[eulerian] start = "flow": measured tracks do not give the unfiltered flow; set start = '
                   '"particles"')


def _sections_of(settings: Tracks, learned: bool) -> dict[str, Flow | Tracers]:
    tracks = read_measured(settings)
    present, where = ((tracks.complete, f"all {len(tracks.times)} frames") if settings.filtered
                      else (int(tracks.starts[1]), "the first frame"))
    if learned and present < LEAST_TRACKS:
        raise SceneError(f"{settings.file}: only {present} of {tracks.about['in_file']} tracks are in {where}, but a "
                         f"model needs {LEAST_TRACKS}; give another part of the file")
    if learned and tracks.uniform:
        raise SceneError(f"{settings.file}: all tracks move alike, so there is no fluctuation that a model could "
                         "learn; give other tracks, or remove [kernel], [model] and [simulation]")
    count = present if learned else max(count_for(tracks.spacing), LEAST_TRACKS)
    speed = float(np.sqrt(np.mean(fluctuations(tracks.columns["velocity"])**2)))
    turnover = INTEGRAL_SCALE * BOX_LENGTH / speed if speed > 0 else math.inf
    width = None if settings.filter_width is None else settings.filter_width / tracks.about["length_unit"]
    tracers = Tracers(count=count, filtered=settings.filtered or learned, frame_interval=float(tracks.times[1]),
                      filter_width=width, turnovers=max(float(tracks.times[-1] / turnover), 1e-6),
                      field_every=settings.field_every)
    viscosity = 0.0 if settings.viscosity is None else settings.viscosity / tracks.about["length_unit"]**2
    cells, sound = max(tracers.cells, planes_for(tracers.particles), LEAST_CELLS), settings.sound_speed
    flow = Flow(fluid="incompressible", cells=cells, viscosity=viscosity) if sound is None else Flow(
        fluid="compressible", cells=cells, viscosity=viscosity, sound_speed=sound / tracks.about["length_unit"])
    return {"flow": flow, "tracers": tracers}


def run(scene: Scene, comm: Comm, directory: str | Path, stop: StopRequest | None = None) -> None:
    """Write ground_truth.h5 of measured tracks; all ranks call it.

    The filtered fields are those of the resolved velocity, which regularised least squares find in the velocities of
    the tracks. If the tracks follow the unfiltered flow, the filter is applied to these fields. If the scene then has
    [kernel], [model] or [simulation], the particles of the product are FilteredTracers instead of the tracks. The
    dissipation rate is the value of the literature for the measured velocity and integral scale
    (`dissipation_constant`).
    """
    tracks, viscosity = TrackFrames(comm, scene.tracks), scene.flow.viscosity
    follows = scene.tracers.filtered and not scene.tracks.filtered
    flows = FittedFlows(tracks, scene.tracers, scene.tracks.filtered, viscosity, follows)
    with create_product(comm, Path(directory) / STAGES["dns"].file, "ground_truth",
                        stage_provenance(scene, "dns")) as file:
        paths, rows, spectra = write_frames(file, flows, tracks, scene.tracers, viscosity, follows, stop)
        reference = flows.reference | (measured_scales(comm, *paths, tracks.times[1]) if follows else {})
        energy = float(spectra["energy"][0].sum())
        sound = {"sound_speed": scene.flow.sound_speed or math.inf}
        if scene.flow.compressible:
            sound["mach_turbulent"] = math.sqrt(2 * energy) / scene.flow.sound_speed
        set_attributes(file.create_group("reference"), {**reference, "released_at": 0.0, "energy": energy, **sound})
        write_table(file, "statistics", Table({name: np.array([row[name] for row in rows]) for name in rows[0]},
                                              units=UNITS))
        write_spectra(file, "spectra", "time", spectra)
        set_attributes(file.create_group("tracks"), {
            **tracks.about, "complete": tracks.complete, "mean_count": tracks.mean_count, "weight": flows.weight,
            **({} if math.isnan(flows.error) else {"validation_error": flows.error}), "traced": follows})
    log.info("dns: %d tracks, on average %.0f in a frame; %d are in each of the %d frames; duration %.3g T, u' = %.3g, "
             "L = %.3g",
             tracks.about["in_file"], tracks.mean_count, tracks.complete, len(tracks.times),
             tracks.times[-1] / reference["eddy_turnover_time"], math.sqrt(2 * energy / 3), reference["integral_scale"])


def write_frames(file: File, flows: FittedFlows, tracks: TrackFrames, tracers: Tracers, viscosity: float,
                 follows: bool, stop: StopRequest | None) -> tuple[list[Columns], list[dict[str, float]], Columns]:
    """Write the particles of each frame, and every few frames the filtered field; collective.

    The particles are FilteredTracers if `follows` is true, else the tracks that are in all frames. Returns the rows of
    this rank in the first two frames of FilteredTracers, the statistics of the flow in each stored frame, and the
    columns `time`, `energy` and `filtered` of its spectra. Raises Stopped if `stop` requests it.
    """
    comm, times, complete, mean = tracks.comm, tracks.times, tracks.complete, tracks.background
    coarse = SpectralGrid(SlabDecomposition(comm, BOX_LENGTH, tracers.cells), cutoff=(tracers.cells - 1) // 2)
    traced = FilteredTracers(flows.slab, tracks.frame(0)) if follows else None
    count = traced.total if traced else complete
    shapes = {name: values.shape[1:] for name, values in tracks.shared(0, 1).items() if name != "id"}
    trajectory = (TrajectoryWriter(file, "tracers", count, BOX_LENGTH, shapes, np.float64)
                  if count >= LEAST_TRACKS else None)
    fields = FieldWriter(file, "filtered", coarse.cells, {"velocity": 3})
    paths, rows, spectra = [], [], []
    progress = ProgressLine("dns", lambda: "tracks", unit="frame")
    for frame, time in enumerate(times):
        progress(frame / len(times), frame)
        if stop is not None:
            stop.check()
        stored = frame % tracers.field_every == 0
        flow = flows.at(tracks.frame(frame), time) if stored or traced else None
        if traced:
            start, columns = traced.follow(flow, times[1] if frame else 0.0)
            paths += [columns] if frame < 2 else []
        else:
            start, columns = id_block(comm, complete)[0], tracks.frame(frame, complete=True)
            if mean is not None:
                columns["velocity"] = columns["velocity"] + mean.at(*columns["position"].T).T
        if trajectory:
            trajectory.append(frame, time, start, columns)
        if not stored:
            continue
        grid, modes = flow.grid.spectral, as_numpy(flow.filtered)
        field = coarse.backward(regrid(grid, coarse, modes))
        fields.append(time, coarse.decomposition.start, {
            "velocity": field if mean is None else field + mean.at(*coarse.coordinates())})
        row = flow.scales(viscosity) | {"time": time, "energy": flow.energy.sum()}
        skewness, flatness = gradient_moments(grid, modes)
        rows.append(row | {"skewness": skewness, "flatness": flatness} | component_energies(grid, modes))
        spectra.append((time, flow.energy, flow.filtered_energy))
    return paths, rows, dict(zip(("time", "energy", "filtered"), map(np.array, zip(*spectra))))


class FittedFlows:
    """The velocity fields of measured tracks, by one method for all frames, which the surest frame determines. The
    constructor is collective.

    slab, grid, method: the slabs, the grid, and the method that finds the modes of a frame. reference: the scales of
    the flow in the first frame. weight, error: the weight of the noise, and the error at left-out tracks, NaN if it was
    not measured. filtered, filter_width: as in `FrameFlow`.
    """

    def __init__(self, tracks: TrackFrames, tracers: Tracers, filtered: bool, viscosity: float, follows: bool) -> None:
        settings = Reconstruction(method="memory" if follows and viscosity > 0 else "least-squares")
        self.filtered, self.filter_width = filtered, tracers.filter_width
        own = tracers.with_count(count_for(tracks.spacing))
        known = {"filter_width": tracers.filter_width, "spacing": tracers.spacing, "density_mean": 1.0,
                 "viscosity": viscosity,
                 **measured_scales(tracks.comm, tracks.shared(0, 1), tracks.shared(1, 0), tracks.times[1])}
        width = tracers.filter_width if filtered else NO_FILTER * tracks.spacing
        self.reference = {"kolmogorov_length": 0.0} | known
        # The first pass does not know the Kolmogorov length. The prior of the second pass uses that of the first pass.
        for resolved in (own, settings.resolving(own, filtered))[:2 if viscosity > 0 else 1]:
            self.slab = slabs_for(tracks.comm, own, resolved, width, self.reference["kolmogorov_length"])
            make = partial(solver_of, self.slab, self.reference | {"spacing": resolved.spacing, "filter_width": width},
                           tracks.about["periods"], filtered)
            clearest = particles_on(self.slab, tracks.frame(surest(tracks.velocity_errors)))
            solver, self.weight, self.error = best_solver(clearest, make, uniform=tracks.uniform)
            self.grid = solver.grid
            self.method = UniformMethod(solver) if tracks.uniform else LeastSquaresMethod(solver)
            # The velocity_rms is that of the particles.
            self.reference = self.at(tracks.frame(0), 0.0).scales(viscosity) | known
        if not tracks.uniform:  # a memory is of an unfiltered flow: G = 1
            self.method = solving_method(settings, solver, viscosity, torch.ones_like(solver.grid.shell), self.weight)

    @torch.no_grad()
    def at(self, columns: Columns, time: float) -> FrameFlow:
        """Return the field of the frame at a time; `columns` are the tracks of this rank. Frames come in order."""
        particles = particles_on(self.slab, columns)
        return FrameFlow(self.grid, self.method.of(particles, time), particles, self.filtered,
                         self.filter_width)


class FrameFlow:
    """The velocity field of one frame.

    Energies are means over the region with particles, so a margin without particles has no effect.

    Parameters
    ----------
    grid, modes : modes (3, kz, ky, kx) of the velocity, and their grid. particles : the particles of the frame.
    filtered, filter_width : whether the particles follow the filtered velocity, and the width of the filter.
    """

    def __init__(self, grid: FourierGrid, modes: Tensor, particles: ParticleSet, filtered: bool,
                 filter_width: float) -> None:
        self.grid, comm, transfer = grid, grid.decomposition.comm, grid.filter_transfer(filter_width)
        whole, self.filtered = (modes * (1 / transfer), modes) if filtered else (modes, modes * transfer)
        among = grid.at(grid.without_mean(modes), grid.points(particles.position))
        square, count = global_sum(comm, np.array([float(among.square().sum()), len(particles.id)]))
        whole_square = 2 * energy_spectrum(grid.spectral, as_numpy(modes)).sum()
        share = square / count / whole_square if whole_square > 0 else 1.0
        self.energy, self.filtered_energy = (share * energy_spectrum(grid.spectral, as_numpy(each))
                                             for each in (whole, self.filtered))

    @torch.no_grad()
    def at(self, position: np.ndarray) -> np.ndarray:
        """Return the filtered velocity (n, 3) at positions (n, 3) on this rank; collective."""
        return as_numpy(self.grid.at(self.filtered, self.grid.points(torch.from_numpy(position))))

    def scales(self, viscosity: float) -> dict[str, float]:
        """Return the scales of `turbulence_scales`, with the `dissipation_rate` eps = C_eps u'^3 / L. C_eps and
        Re_lambda depend on each other, so both are found by iteration."""
        cutoff = self.grid.resolved
        found = turbulence_scales(self.energy, 0.0, 0.0, cutoff)
        speed, length = found["velocity_rms"], found["integral_scale"]
        rate, reynolds = 0.0, math.inf
        for _ in range(ROUNDS if length > 0 else 0):
            rate = dissipation_constant(reynolds) * speed**3 / length
            reynolds = math.sqrt(15 / (viscosity * rate)) * speed**2 if viscosity > 0 else math.inf
        return turbulence_scales(self.energy, rate, viscosity, cutoff) | {"dissipation_rate": rate}


class FilteredTracers:
    """Particles that follow the filtered velocity of reconstructed fields, by Heun's method from frame to frame.

    They start at the positions of the tracks in the first frame. `columns` holds this rank's rows of that frame. All
    methods are collective.
    """

    def __init__(self, slab: SlabDecomposition, columns: Mapping[str, np.ndarray]) -> None:
        counts, self.slab = slab.comm.allgather(len(columns["id"])), slab
        self.total, first = sum(counts), sum(counts[:slab.comm.rank])
        self._now = migrate(slab, {"id": first + np.arange(len(columns["id"])), "position": columns["position"]})

    def follow(self, flow: FrameFlow, step: float) -> tuple[int, dict[str, np.ndarray]]:
        """Move the particles by a time `step` to the time of `flow`; `step` is 0 in the first frame.

        Returns the id of this rank's first row, and its rows of position and velocity in order of id.
        """
        if step > 0:
            ahead = migrate(self.slab, {**self._now, "before": self._now["position"],
                                        "position": self._now["position"] + step * self._now["velocity"]})
            velocity = (ahead["velocity"] + flow.at(ahead["position"])) / 2
            self._now = migrate(self.slab, {"id": ahead["id"], "position": ahead["before"] + step * velocity})
        self._now["velocity"] = flow.at(self._now["position"])
        order = IdOrder(self.slab.comm, self._now["id"], self.total)
        return order.start, {name: order.apply(self._now[name]) for name in ("position", "velocity")}
