"""Fields from particle tracks: velocity, gradient, pressure and acceleration of each frame, with an estimate of errors.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from eddies.clock import ProgressLine
from eddies.io.fields import FieldWriter
from eddies.io.hdf5 import (File, append_frame, create_product, growing_dataset, open_product, read_attributes,
                            write_attributes, write_table)
from eddies.io.trajectories import write_h5md_header
from eddies.parallel.communicator import Comm
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.parallel.stop import StopRequest
from eddies.particles.devices import prepare_torch
from eddies.particles.exchanges import mean_over_ranks
from eddies.particles.forms import Form
from eddies.particles.fourier_grid import FourierGrid
from eddies.particles.particle_field import ParticleField
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.particles.remembered_velocity import RememberedVelocity
from eddies.particles.resolved_velocity import ResolvedVelocity
from eddies.particles.smoothing_kernels import CubicSpline
from eddies.pipeline import STAGES
from eddies.scene.scene import BOX_LENGTH, Scene
from eddies.scene.sections import NEIGHBORS, RECONSTRUCTED
from eddies.spectral.spectral_grid import SpectralGrid, regrid
from eddies.workflows.ground_truth.track_frames import TrackFrames
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.learned.model import load_form
from eddies.workflows.run_directory.fingerprints import stage_provenance
from eddies.workflows.track_solver import NO_FILTER, best_solver, particles_on, solver_of, split, validation_error

log = logging.getLogger("eddies")


class Method(Protocol):
    """Makes the modes (3, kz, ky, kx) of the velocity of particles, relative to its mean, frame by frame."""

    def of(self, particles: ParticleSet, time: float) -> Tensor:
        """The modes at a time; collective."""


class LeastSquaresMethod:
    """The solver of each frame alone; it starts from the modes of the frame before."""

    def __init__(self, solver: ResolvedVelocity) -> None:
        self._solver, self._near = solver, None

    @torch.no_grad()
    def of(self, particles: ParticleSet, time: float) -> Tensor:
        self._near = self._solver.of(particles, near=self._near).velocity
        return self._near


class NeighbourMethod:
    """A form of reconstruction from the neighbours of each grid point, on a grid of modes."""

    def __init__(self, form: Form, grid: FourierGrid) -> None:
        self._form, self._grid = form, grid

    @torch.no_grad()
    def of(self, particles: ParticleSet, time: float) -> Tensor:
        slab = self._grid.decomposition
        field = ParticleField(slab, self._form.support, particles.position, particles.velocity)
        velocity = self._form.of(field).velocity_on_grid().T.reshape(3, slab.count, slab.planes, slab.planes)
        mean = torch.from_numpy(np.asarray(as_numpy(mean_over_ranks(slab.comm, particles.velocity))))
        return self._grid.to_modes(velocity.to(self._grid.dtype) - mean.to(self._grid.dtype)[:, None, None, None])


class ParticleRows:
    """Writes quantities at the particles of each frame to particles/tracks, in the layout of H5MD; collective.

    Rows are sorted by id. Frames with fewer particles than `most` end with rows of the id -1.
    """

    def __init__(self, comm: Comm, file: File, most: int, wanted: tuple[str, ...], unit: float,
                 corner: np.ndarray) -> None:
        self._comm, self._most, self._unit, self._corner = comm, most, unit, corner
        write_h5md_header(file)
        group = file.create_group("particles/tracks")
        write_attributes(group.create_group("box"), {"dimension": 3, "edge": BOX_LENGTH * unit})
        self._time = growing_dataset(group, "time", (), np.float64)
        shapes = {"id": (), "position": (3,), **{name: (RECONSTRUCTED[name],) for name in wanted}}
        self._columns = {name: growing_dataset(group, f"{name}/value", (most, *shape), np.int64 if name == "id" else
                                               np.float32) for name, shape in shapes.items()}

    def append(self, time: float, particles: ParticleSet, values: Mapping[str, np.ndarray]) -> None:
        """Add a frame: the particles of this rank and the values at them."""
        columns = {"id": as_numpy(particles.id), "position": as_numpy(particles.position) * self._unit - self._corner,
                   **values}
        append_frame(self._time, np.array(time), ())
        for name, dataset in self._columns.items():
            parts, ids = self._comm.gather(columns[name]), self._comm.gather(columns["id"])
            block = np.zeros((0, *dataset.shape[2:]))
            if parts is not None:
                block = np.full((self._most, *dataset.shape[2:]), -1 if name == "id" else 0.0)
                order = np.argsort(np.concatenate(ids))
                block[:len(order)] = np.concatenate(parts)[order]
            append_frame(dataset, block, (0,) * (dataset.ndim - 1))


def run(scene: Scene, comm: Comm, directory: str | Path, stop: StopRequest | None = None) -> None:
    """Write reconstruction.h5: the quantities of [reconstruction] fields on a grid, and errors over time.

    With u the velocity of the tracks, u* = u / G that before their filter, if they follow a filtered one, and P the
    projection on solenoidal fields, the acceleration along a track is  -G P[div(u* u*)] + nu laplacian u + div(u u),
    and the pressure G p[u*]. All are those of the modes that particles resolve, in the units of the tracks.
    """
    prepare_torch("cpu", comm)
    settings, tracers, directory = scene.reconstruction, scene.tracers, Path(directory)
    with ExitStack() as files:
        truth_file = files.enter_context(open_product(comm, directory / STAGES["dns"].file, "ground_truth"))
        reference, unit, corner = read_attributes(truth_file, "reference"), 1.0, np.zeros(3)
        truth, source = None, None
        if scene.tracks is not None:
            source = TrackFrames(comm, scene.tracks)
            times, count = source.times, (BOX_LENGTH / source.spacing) ** 3
            unit, corner = source.about["length_unit"], source.about["corner"]
        slab = SlabDecomposition(comm, BOX_LENGTH, tracers.planes)
        if source is None:
            truth = GroundTruth(truth_file, slab)
            times, count = truth.times, truth.total
        else:
            slab = SlabDecomposition(comm, BOX_LENGTH, tracers.with_count(round(count)).planes)

        def particles(frame: int) -> ParticleSet:
            if source is not None:
                return particles_on(slab, source.frame(frame))
            return ParticleSet.from_numpy({name: values for name, values in truth.particles(frame).items()
                                           if name != "density"})

        spacing = BOX_LENGTH / count ** (1 / 3)
        width = tracers.filter_width if tracers.filtered else NO_FILTER * spacing
        solver, weight, error = best_solver(particles(0), partial(
            solver_of, slab, reference | {"spacing": spacing, "filter_width": width}), settings.holdout or 0.1)
        grid, frames = solver.grid, range(0, len(times), settings.every)
        transfer = grid.filter_transfer(tracers.filter_width) if tracers.filtered else torch.ones_like(grid.shell)
        make = _maker(scene, comm, directory, solver, weight, transfer, truth)
        methods = [make(), make()] if settings.holdout > 0 else [make()]
        cells = settings.cells or tracers.cells
        target = SpectralGrid(SlabDecomposition(comm, BOX_LENGTH, cells), cutoff=(cells - 1) // 2)
        progress = ProgressLine("reconstruct", lambda: settings.method, unit="frame")
        rows: list[dict[str, float]] = []
        compared: list[dict[str, float]] = []
        with create_product(comm, directory / STAGES["reconstruct"].file, "reconstruction",
                            stage_provenance(scene, "reconstruct")) as file:
            writer = FieldWriter(file, "reconstructed", cells, {name: RECONSTRUCTED[name] for name in settings.fields})
            rows_of_particles = None
            if settings.particles:
                most = truth.total if truth is not None else source.most
                rows_of_particles = ParticleRows(comm, file, most, settings.fields, unit, corner)
            for number, frame in enumerate(frames):
                if stop is not None:
                    stop.check()
                now, began = particles(frame), time.perf_counter()
                modes = methods[0].of(now, float(times[frame]))
                row = {"time": float(times[frame]), "seconds": time.perf_counter() - began}
                mean = as_numpy(mean_over_ranks(comm, now.velocity))
                made = Quantities(modes, mean, transfer, reference["viscosity"], grid, settings.fields, unit)
                writer.append(times[frame], target.decomposition.start, made.on(target))
                if rows_of_particles is not None:
                    rows_of_particles.append(float(times[frame]), now, made.at(now))
                if settings.holdout > 0:
                    known, apart = split(now, settings.holdout)
                    row["validation_error"] = validation_error(solver, methods[1].of(known, float(times[frame])), known,
                                                               apart)
                rows.append(row)
                if truth is not None and frame in truth.at_fields:
                    compared.append({"time": row["time"], **errors_of(
                        modes, mean, tracers.filtered, tracers.filter_width, grid, truth, frame)})
                progress((number + 1) / len(frames), number + 1)
            for name, table in (("errors_over_time", rows), ("errors_of_fields", compared)):
                if table:
                    write_table(file, name, {key: np.array([row[key] for row in table]) for key in table[0]})
            write_attributes(file.create_group("about"), {
                "method": settings.method, "particles": float(count), "weight": weight, "length_unit": unit,
                "corner": corner, "holdout": settings.holdout, "highest_wavenumber": grid.resolved})
    log.info("reconstruct: %s; means over time: %s", settings.method, ", ".join(
        f"{key.replace('_', ' ')} {np.mean([row[key] for row in table]):.3g}"
        for table in (rows, compared) if table for key in table[0] if key != "time"))


def _maker(scene: Scene, comm: Comm, directory: Path, solver: ResolvedVelocity, weight: float,
           transfer: Tensor, truth: GroundTruth | None) -> Callable[[], Method]:
    """A function that makes a new method of [reconstruction]."""
    settings, tracers = scene.reconstruction, scene.tracers
    if settings.method == "least-squares":
        return lambda: LeastSquaresMethod(solver)
    if settings.method == "memory":
        return lambda: RememberedVelocity(solver, scene.flow.viscosity, transfer, settings.memory, weight)
    kernel_file = directory / STAGES["train-kernel"].file
    if scene.kernel is not None and truth is not None:
        kernel = load_form(comm, kernel_file, truth.scales).kernel
    else:
        kernel = CubicSpline(tracers.radius_of(NEIGHBORS))
    form = Form(settings.method, kernel, tracers.filter_width, tracers.spacing**3)
    return lambda: NeighbourMethod(form, solver.grid)


class Quantities:
    """The quantities of one frame, made from the modes of the velocity relative to its mean.

    Parameters
    ----------
    modes : (3, kz, ky, kx) on `grid`. mean : of the velocity, (3,). transfer : G of the filter that it has passed.
    viscosity : nu. wanted : names of RECONSTRUCTED. unit : of length.
    """

    @torch.no_grad()
    def __init__(self, modes: Tensor, mean: np.ndarray, transfer: Tensor, viscosity: float, grid: FourierGrid,
                 wanted: tuple[str, ...], unit: float) -> None:
        self.grid, self.wanted, self.unit, self.mean = grid, wanted, unit, mean
        self._modes = {"velocity": modes}
        if {"gradient", "vorticity", "q", "r"} & {*wanted}:
            self._modes["gradient"] = torch.cat([grid.gradient(component) for component in modes])
        if {"pressure", "acceleration"} & {*wanted}:
            whole = grid.squares(modes / transfer)
            self._modes["pressure"] = (transfer * grid.pressure_of(whole))[None]
            self._modes["acceleration"] = (
                grid.stress_divergence(grid.squares(modes)) - transfer * grid.solenoidal(grid.stress_divergence(whole))
                - viscosity * grid.wavenumber_squared * modes)

    def on(self, target: SpectralGrid) -> dict[str, np.ndarray]:
        """Planes (components, z_local, y, x) on another grid; collective."""
        return self._of(lambda modes: target.backward(regrid(self.grid.spectral, target, as_numpy(
            modes.resolve_conj()))))

    @torch.no_grad()
    def at(self, particles: ParticleSet) -> dict[str, np.ndarray]:
        """Values (n, components) at the particles of this rank; collective."""
        points = self.grid.points(particles.position)
        found = self._of(lambda modes: as_numpy(self.grid.at(modes, points)).T)
        return {name: values.T for name, values in found.items()}

    def _of(self, values: Callable[[Tensor], np.ndarray]) -> dict[str, np.ndarray]:
        """The quantities from the values (components, ...) of modes."""
        given = {name: values(modes) for name, modes in self._modes.items()}
        velocity = given["velocity"]
        found = {"velocity": self.unit * (velocity + self.mean.reshape(3, *[1] * (velocity.ndim - 1)))}
        if "gradient" in given:
            a = given["gradient"].reshape(3, 3, *velocity.shape[1:])
            square = np.einsum("ij...,jk...->ik...", a, a)
            found |= {"gradient": given["gradient"],
                      "vorticity": np.stack([a[2, 1] - a[1, 2], a[0, 2] - a[2, 0], a[1, 0] - a[0, 1]]),
                      "q": -np.einsum("ii...->...", square)[None] / 2,
                      "r": -np.einsum("ij...,ji...->...", square, a)[None] / 3}
        if "pressure" in given:
            found |= {"pressure": self.unit**2 * given["pressure"], "acceleration": self.unit * given["acceleration"]}
        return {name: found[name] for name in self.wanted}


def errors_of(modes: Tensor, mean: np.ndarray, filtered: bool, filter_width: float, grid: FourierGrid,
              truth: GroundTruth, frame: int) -> Mapping[str, float]:
    """Normalised L2 errors of the filtered velocity and its gradient at a frame whose field the ground truth has."""
    slab = SlabDecomposition(grid.decomposition.comm, BOX_LENGTH, truth.fields.cells)
    target = SpectralGrid(slab, cutoff=(slab.planes - 1) // 2)
    exact = truth.planes(truth.fields, truth.at_fields.index(frame), "velocity", slab)
    given = modes if filtered else modes * grid.filter_transfer(filter_width)
    found = {"velocity": target.backward(regrid(grid.spectral, target, as_numpy(given.resolve_conj())))
             + mean[:, None, None, None]}
    errors = {"velocity": (found["velocity"], exact)}
    slopes = [np.concatenate([target.backward(target.gradient(component)) for component in target.forward(field)])
              for field in errors["velocity"]]
    errors["gradient"] = slopes[0], slopes[1]
    result = {}
    for name, (own, true) in errors.items():
        square, whole = global_sum(slab.comm, np.array([np.sum((own - true) ** 2), np.sum(true**2)]))
        result[f"{name}_error"] = float(np.sqrt(square / whole))
    return result
