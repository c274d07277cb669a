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
from eddies.io.hdf5 import create_product, open_product, read_attributes, write_attributes, write_table
from eddies.io.quantities import python_value
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
        reference, unit = read_attributes(truth_file, "reference"), 1.0
        truth, source = None, None
        if scene.tracks is not None:
            source = TrackFrames(comm, scene.tracks)
            times, count = source.times, source.mean_count
            unit = float(python_value(source.about["length_unit"]))
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
            for number, frame in enumerate(frames):
                if stop is not None:
                    stop.check()
                now, began = particles(frame), time.perf_counter()
                modes = methods[0].of(now, float(times[frame]))
                row = {"time": float(times[frame]), "seconds": time.perf_counter() - began}
                mean = as_numpy(mean_over_ranks(comm, now.velocity))
                writer.append(times[frame], target.decomposition.start, quantities(
                    modes, mean, transfer, reference["viscosity"], grid, target, settings.fields, unit))
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
                "holdout": settings.holdout, "highest_wavenumber": grid.resolved})
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


@torch.no_grad()
def quantities(modes: Tensor, mean: np.ndarray, transfer: Tensor, viscosity: float, grid: FourierGrid,
               target: SpectralGrid, wanted: tuple[str, ...], unit: float) -> dict[str, np.ndarray]:
    """Planes (components, z_local, y, x) of the wanted quantities on a grid, in units of length `unit`.

    modes : of the velocity, relative to its mean (3,). transfer : G of the filter that it has passed.
    """
    def planes(of: Tensor) -> np.ndarray:
        return target.backward(regrid(grid.spectral, target, as_numpy(of.resolve_conj())))

    found: dict[str, np.ndarray] = {}
    if "velocity" in wanted:
        found["velocity"] = unit * (planes(modes) + mean[:, None, None, None])
    if {"gradient", "vorticity", "q", "r"} & {*wanted}:
        slopes = planes(torch.cat([grid.gradient(component) for component in modes]))
        a = slopes.reshape(3, 3, *slopes.shape[1:])
        square = np.einsum("ijzyx,jkzyx->ikzyx", a, a)
        found |= {"gradient": slopes, "vorticity": np.stack([a[2, 1] - a[1, 2], a[0, 2] - a[2, 0], a[1, 0] - a[0, 1]]),
                  "q": -np.einsum("iizyx->zyx", square)[None] / 2,
                  "r": -np.einsum("ijzyx,jizyx->zyx", square, a)[None] / 3}
    if {"pressure", "acceleration"} & {*wanted}:
        whole = grid.squares(modes / transfer)
        found["pressure"] = unit**2 * planes((transfer * grid.pressure_of(whole))[None])
        change = -transfer * grid.solenoidal(grid.stress_divergence(whole)) - viscosity * (
            grid.wavenumber_squared * modes)
        found["acceleration"] = unit * planes(change + grid.stress_divergence(grid.squares(modes)))
    return {name: found[name] for name in wanted}


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
