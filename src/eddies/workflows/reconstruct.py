"""Fields from particle tracks: velocity, gradient, pressure and acceleration of each frame, with an estimate of errors.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import starmap
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from torch import Tensor

from eddies.analysis.linear_flow import LinearFlow
from eddies.clock import ProgressLine
from eddies.io.checkpoint import Checkpoint, Guard
from eddies.io.flow_states import restored_modes, saved_modes
from eddies.io.frame_segments import FieldLayout, FrameLayout, FrameSegments, TrajectoryLayout
from eddies.io.hdf5 import File, Table, create_product, open_product, write_table
from eddies.io.new_files import set_attributes
from eddies.io.units import DEVIATION
from eddies.parallel.communicator import Comm
from eddies.parallel.slab import SlabDecomposition
from eddies.parallel.stop import StopRequest
from eddies.particles.devices import prepare_torch
from eddies.particles.error_samples import ErrorSamples
from eddies.particles.exchanges import fluctuations, relative_error
from eddies.particles.particle_field import Form, ParticleField
from eddies.particles.fourier_grid import FourierGrid, Points
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.particles.remembered_velocity import RememberedVelocity
from eddies.particles.resolved_velocity import ResolvedVelocity, captured_dissipation
from eddies.particles.smoothing_kernels import SmoothingKernel
from eddies.pipeline import STAGES
from eddies.scene.scene import BOX_LENGTH, Reconstruction, Scene, Tracers
from eddies.scene.sections import RECONSTRUCTED
from eddies.spectral.spectral_grid import SYMMETRIC, SpectralGrid, regrid
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.learned.model import load_form
from eddies.workflows.left_out_tracks import errors_at_left_out, kernel_of
from eddies.workflows.run_directory.fingerprints import stage_fingerprint, stage_provenance
from eddies.workflows.track_solver import HELD_OUT, Method, UniformMethod, solving_method, split, validation_error
from eddies.workflows.track_source import GivenPoints, Source

log = logging.getLogger("eddies")

# Arrays of modes in the states of methods and samples, with their numbers of dimensions.
MODES = {"modes": 4, "penalty": 3, "errors": 4}


class NeighbourMethod(Method):
    """Reconstructs the velocity at each grid point from the particles around it, and transforms it to modes."""

    def __init__(self, form: Form, grid: FourierGrid) -> None:
        self._form, self._grid = form, grid

    @torch.no_grad()
    def of(self, particles: ParticleSet, time: float) -> Tensor:
        slab = self._grid.decomposition
        field = ParticleField(slab, self._form.support, particles.position, particles.velocity)
        velocity = self._form.on_grid(field).T.reshape(3, slab.count, slab.planes, slab.planes)
        return self._grid.to_modes(velocity.to(self._grid.dtype))


class ReconstructionRun:
    """Reconstructs frame after frame and writes the results to segments, from the start or from a checkpoint.

    Parameters
    ----------
    source : the particles.
    methods : a method for all particles. With [reconstruction] holdout, also one for the particles that remain.
    samples : draws the errors of the first method. solver : solver on the grid of the modes.
    settings, tracers : sections [reconstruction] and [tracers].
    medium : what the quantities depend on beside the velocity.
    """

    def __init__(self, source: Source, methods: Sequence[Method], samples: ErrorSamples, settings: Reconstruction,
                 tracers: Tracers, medium: Medium) -> None:
        self.source, self.methods, self.samples, self.solver = source, methods, samples, samples.solver
        self.grid = self.solver.grid
        self.settings, self.tracers, self.medium = settings, tracers, medium
        self.frames = range(0, len(source.times), settings.every)
        self.points = (None if settings.points_file is None else
                       GivenPoints(source, settings.points_file, source.times[self.frames]))
        cells = settings.cells or tracers.cells
        self.target = SpectralGrid(SlabDecomposition(source.slab.comm, BOX_LENGTH, cells), cutoff=(cells - 1) // 2)
        self.errors: list[dict[str, float]] = []
        self.of_fields: list[dict[str, float]] = []

    @property
    def steps(self) -> int:
        """Number of frames reconstructed so far."""
        return len(self.errors)

    @property
    def layout(self) -> FrameLayout:
        """The datasets of the frames. The column `track` of `tracks` is the id of a row's track, and `row` of `points`
        the row of the file; both are -1 in empty rows."""
        values = {name: RECONSTRUCTED[name] for name in self.settings.fields}
        values |= {name + DEVIATION: RECONSTRUCTED[name] for name in self.settings.deviations}
        columns = {"coordinates": (3,), **{name: (count,) for name, count in values.items()}}
        rows = {}
        if self.settings.particles:
            rows["tracks"] = TrajectoryLayout(self.source.most, {"track": (), **columns})
        if self.points is not None:
            rows["points"] = TrajectoryLayout(self.points.most, {"row": (), **columns})
        return FrameLayout(BOX_LENGTH, rows, np.float64,
                           {"reconstructed": FieldLayout(self.target.decomposition.planes, values)})

    def run(self, guard: Guard, segments: FrameSegments) -> None:
        """Reconstruct the frames that are left."""
        progress = ProgressLine("reconstruct", lambda: self.settings.method, done=self.steps / len(self.frames),
                                unit="frame")
        while self.steps < len(self.frames):
            guard(self, segments)
            segments.open(self.steps)
            self._next(segments)
            progress(self.steps / len(self.frames), self.steps)

    def _next(self, segments: FrameSegments) -> None:
        frame, comm = self.frames[self.steps], self.source.slab.comm
        time, particles, began = float(self.source.times[frame]), self.source.particles(frame), perf_counter()
        modes = self.methods[0].of(particles, time)
        row = {"time": time, "seconds": perf_counter() - began}
        sets = {"tracks": particles} if self.settings.particles else {}
        if self.points is not None:
            sets["points"] = self.points.at(self.steps)
        made = Quantities(modes, self.grid, self.settings.fields, self.medium)
        places = [(self.grid.points(each.position), as_numpy(each.position)) for each in sets.values()]
        found = [made.on(self.target), *starmap(made.at, places)]
        for spread, values in zip(self._deviations(particles, modes, frame, places), found):
            values |= spread
        on_grid, *at_sets = found
        segments.fields["reconstructed"].append(time, self.target.decomposition.start, on_grid)
        for (name, each), values in zip(sets.items(), at_sets):
            place = as_numpy(each.position) * self.source.unit - self.source.corner
            most, key = self.layout.trajectories[name].total, "track" if name == "tracks" else "row"
            rows = sorted_rows(comm, most, key, {key: as_numpy(each.id), "coordinates": place, **values})
            segments.trajectories[name].append(frame, time, 0 if comm.rank == 0 else most, rows)
        if len(self.methods) > 1:
            known, apart = split(particles, self.settings.holdout)
            row["validation_error"] = validation_error(self.solver, self.methods[1].of(known, time), apart)
        if self.source.truth is not None and frame in self.source.truth.field_frames:
            self.of_fields.append({"time": time, **errors_of(modes, self.tracers, self.grid, self.source.truth,
                                                             frame)})
        self.errors.append(row)

    def _deviations(self, particles: ParticleSet, modes: Tensor, frame: int,
                    places: Sequence[tuple[Points, np.ndarray]]) -> list[dict[str, np.ndarray]]:
        """Return the standard deviations of the errors on the grid, and then at each of `places`."""
        squares: list[dict[str, np.ndarray]] = [{} for _ in range(1 + len(places))]
        medium = replace(self.medium, background=None)
        for error in self.samples.of(particles, modes, frame, *self.source.velocity_errors[frame]):
            made = Quantities(error, self.grid, self.settings.deviations, medium)
            for total, values in zip(squares, [made.on(self.target), *starmap(made.at, places)]):
                for name, value in values.items():
                    total[name] = total.get(name, 0.0) + value**2
        return [{name + DEVIATION: np.sqrt(square / self.samples.count) for name, square in total.items()}
                for total in squares]

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a checkpoint, without the frames, which have files of their own."""
        state: dict[str, Any] = {"reconstruct": {"errors": self.errors, "of_fields": self.of_fields, "plain": []}}
        for number, part in enumerate([*self.methods, self.samples]):
            plain = {}
            for name, value in part.state_dict().items():
                if isinstance(value, Tensor):
                    state[f"{name}-{number}"] = saved_modes(self.grid.spectral, as_numpy(value.resolve_conj()))
                else:
                    plain[name] = value
            state["reconstruct"]["plain"].append(plain)
        return state

    def load_state_dict(self, saved: Checkpoint) -> None:
        """Continue from a checkpoint that was made on any number of ranks."""
        state = saved["reconstruct"]
        self.errors, self.of_fields = state["errors"], state["of_fields"]
        for number, part in enumerate([*self.methods, self.samples]):
            modes = {name: torch.from_numpy(restored_modes(self.grid.spectral, saved, dimensions, f"{name}-{number}"))
                     for name, dimensions in MODES.items() if f"{name}-{number}" in saved}
            part.load_state_dict({**state["plain"][number], **modes})


def sorted_rows(comm: Comm, most: int, key: str, columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Collect the rows of all ranks on rank 0, sorted by the column `key`, and add empty rows, where it is -1.

    Rank 0 then has `most` rows, other ranks have none. Collective.
    """
    parts = comm.gather(dict(columns))
    if parts is None:
        return {name: values[:0] for name, values in columns.items()}
    whole = {name: np.concatenate([part[name] for part in parts]) for name in columns}
    order, rows = np.argsort(whole[key]), {}
    for name, values in whole.items():
        rows[name] = np.full((most, *values.shape[1:]), -1.0 if name == key else 0.0)
        rows[name][:len(order)] = values[order]
    return rows


def run(scene: Scene, comm: Comm, directory: str | Path, stop: StopRequest | None = None) -> None:
    """Write reconstruction.h5: the quantities of [reconstruction] fields on a grid, and errors over time.

    u is the velocity of the tracks, and u* = u / G is the velocity before their filter (G = 1 without a filter). P is
    the projection on solenoidal fields. The acceleration along a track is -G P[div(u* u*)] + nu laplacian u + div(u u).
    The pressure is G p, with the incompressible pressure p of u*. All quantities are in the units of the tracks and
    contain only the modes that the particles resolve, and the background of [tracks]. A stopped reconstruction
    continues from its newest checkpoint.
    """
    prepare_torch("cpu", comm)
    settings, tracers, directory = scene.reconstruction, scene.tracers, Path(directory)
    guard = Guard(comm, directory / STAGES["reconstruct"].checkpoints, stage_fingerprint(scene, "reconstruct"), stop,
                  " of the reconstruction")
    with open_product(comm, directory / STAGES["dns"].file, "ground_truth") as file:
        source = Source(scene.tracks, tracers, settings, file, comm)
        solver, weight, transfer = source.fitted(settings.holdout or HELD_OUT)
        grid = solver.grid
        kernel: SmoothingKernel = kernel_of(tracers)
        if settings.of_neighbors and scene.kernel is not None and source.truth is not None:
            kernel = load_form(comm, directory / STAGES["train-kernel"].file, source.truth.scales).kernel
        make = (partial(UniformMethod, solver) if source.uniform else
                _maker(settings, tracers, scene.flow.viscosity, kernel, solver, weight, transfer))
        holdout = 0.0 if source.uniform else settings.holdout
        methods = [make() for _ in range(2 if holdout > 0 else 1)]
        samples = ErrorSamples(solver, settings.samples, methods[0] if isinstance(methods[0], RememberedVelocity)
                               else None, source.error_weights, settings.every)
        expected = _of_small_scales(source, grid)
        density = scene.tracks.density if scene.tracks is not None else None
        medium = Medium(transfer, source.scales["viscosity"], source.unit, source.background, density or 1.0,
                        expected.get("dissipation_share", 1.0) if settings.correct_dissipation else 1.0)
        whole = ReconstructionRun(source, methods, samples, settings, tracers, medium)
        saved = guard.checkpoints.newest()
        if saved is None and settings.samples:
            samples.measure(source.particles(source.surest), source.velocity_errors[source.surest, 0])
        if saved is not None:
            whole.load_state_dict(saved)
            log.info("reconstruct: continues from frame %d", whole.steps)
        before = () if saved is None else saved.files
        with FrameSegments(comm, guard.checkpoints.path, whole.layout, before) as segments:
            whole.run(guard, segments)
            left_out: dict[str, float] = {}
            if scene.tracks is not None and holdout > 0:
                guard.save(whole, segments)  # the comparison may take longer than the frames
                left_out = errors_at_left_out(scene, source, file, guard.stop)
            with create_product(comm, directory / STAGES["reconstruct"].file, "reconstruction",
                                stage_provenance(scene, "reconstruct")) as product:
                segments.assemble(product)
                _describe(product, expected, density is not None)
                if scene.tracks is not None and holdout > 0:
                    set_attributes(product.create_group("left_out"), left_out)
                tables = {"errors_over_time": whole.errors, "errors_of_fields": whole.of_fields}
                for name, table in tables.items():
                    if table:
                        write_table(product, name, Table({key: np.array([row[key] for row in table])
                                                          for key in table[0]}, "time", {"time": "T", "seconds": "s"}))
                set_attributes(product.create_group("about"), {
                    "method": settings.method, "particles": (BOX_LENGTH / source.spacing) ** 3, "weight": weight,
                    "length_unit": source.unit, "corner": source.corner, "periods": source.periods,
                    "holdout": holdout, "highest_wavenumber": grid.resolved, "samples": settings.samples, **expected})
    guard.checkpoints.remove()
    log.info("reconstruct: %s; means over time: %s", settings.method, ", ".join(
        f"{key.replace('_', ' ')} {np.nanmean([row[key] for row in table]):.3g}"
        for table in tables.values() if table for key in table[0] if key != "time"))


def _of_small_scales(source: Source, grid: FourierGrid) -> dict[str, float]:
    """Return attributes for a flow whose Kolmogorov length eta is known: `spacing_over_eta`, and `dissipation_share`,
    the share of the dissipation rate of the whole flow that the modes are expected to contain."""
    eta = source.scales["kolmogorov_length"]
    return {"spacing_over_eta": source.spacing / eta, "dissipation_share": captured_dissipation(
        grid, source.scales["filter_width"], eta)} if eta > 0 else {}


def _describe(product: File, expected: Mapping[str, float], with_density: bool) -> None:
    """Give datasets of a product attributes that their names do not show: the units of a pressure with a density, and
    the share of the dissipation rate of the whole flow that the modes are expected to contain. Log this share."""
    if "dissipation_share" in expected:
        log.info("reconstruct: by the spectrum of turbulence the modes contain %.2g %% of the dissipation rate",
                 100 * expected["dissipation_share"])
    told = {"pressure": {"units": "M/(L T^2)"} if with_density else {},
            "dissipation": {"share": expected["dissipation_share"]} if "dissipation_share" in expected else {}}
    for place in ("fields/reconstructed/{}", "particles/tracks/{}/value", "particles/points/{}/value"):
        for name, attributes in told.items():
            if place.format(name) in product:
                set_attributes(product[place.format(name)], attributes)


def _maker(settings: Reconstruction, tracers: Tracers, viscosity: float, kernel: SmoothingKernel,
           solver: ResolvedVelocity, weight: float, transfer: Tensor) -> Callable[[], Method]:
    """Return a function that makes a new method of [reconstruction]. Only estimates from neighbours use the kernel."""
    if not settings.of_neighbors:
        return lambda: solving_method(settings, solver, viscosity, transfer, weight)
    form = Form(settings.method, kernel, tracers.filter_width)
    return lambda: NeighbourMethod(form, solver.grid)


@dataclass(frozen=True)
class Medium:
    """What the quantities depend on beside the velocity.

    Parameters
    ----------
    transfer : G (kz, ky, kx), the transfer function of the filter of the velocity. viscosity : nu.
    unit : as in `Source`.
    background : a mean flow W that is added to the velocity. Gradients and their products are those of the sum. For the
        pressure and the acceleration W is steady, and its own pressure is added. With the filter's variance s^2 of a
        coordinate, W and the velocity u of the modes together have the kinematic pressure 2 G_ij i k_i u_j / k^2, and
        minus its gradient and s^2 (k.G k) u are accelerations.
    density : factor of pressures.
    share : share of the dissipation rate that the modes contain; the rest is added in proportion.
    """

    transfer: Tensor
    viscosity: float
    unit: float = 1.0
    background: LinearFlow | None = None
    density: float = 1.0
    share: float = 1.0


class Quantities:
    """The quantities of one frame, made from the modes of the velocity.

    Parameters
    ----------
    modes : (3, kz, ky, kx) on `grid`.
    wanted : quantities to compute, names in RECONSTRUCTED.
    """

    @torch.no_grad()
    def __init__(self, modes: Tensor, grid: FourierGrid, wanted: tuple[str, ...], medium: Medium) -> None:
        self.grid, self.wanted, self.medium = grid, wanted, medium
        transfer, background = medium.transfer, medium.background
        self._modes = {"velocity": modes}
        if {"gradient", "vorticity", "strain", "dissipation", "q", "r"} & {*wanted}:
            self._modes["gradient"] = torch.cat([grid.gradient(component) for component in modes])
        if {"pressure", "acceleration"} & {*wanted}:
            mean, modes = grid.mean(modes), grid.without_mean(modes)  # a mean velocity adds only round-off errors
            whole = grid.squares(modes / transfer)
            self._modes["pressure"] = (transfer * grid.pressure_of(whole))[None]
            self._modes["acceleration"] = (
                grid.stress_divergence(grid.squares(modes)) - transfer * grid.solenoidal(grid.stress_divergence(whole))
                - medium.viscosity * grid.wavenumber_squared * modes)
            if background is not None:
                self._steady = replace(background, velocity=background.velocity + as_numpy(mean))
                gradient = torch.from_numpy(background.gradient)
                pressure = 2 * grid.inverse_squared * grid.divergence(torch.stack(
                    [sum(factor * component for factor, component in zip(row, modes)) for row in gradient]))
                variance = -2 * grid.inverse_squared * transfer.log()
                turned = [sum(factor * k for factor, k in zip(row, grid.wavevector)) for row in gradient]
                self._modes["pressure"] += pressure
                self._modes["acceleration"] += (
                    variance * grid.along_wavevector(turned) * modes - grid.gradient(pressure))

    def on(self, target: SpectralGrid) -> dict[str, np.ndarray]:
        """Return the wanted quantities by name, as planes (components, z_local, y, x) of `target`; collective."""
        return self._of(lambda modes: target.backward(regrid(self.grid.spectral, target, as_numpy(
            modes.resolve_conj()))), target.coordinates())

    @torch.no_grad()
    def at(self, points: Points, position: np.ndarray) -> dict[str, np.ndarray]:
        """Return the wanted quantities by name, (n, components) at the points of this rank; collective."""
        found = self._of(lambda modes: as_numpy(self.grid.at(modes, points)).T, position.T)
        return {name: values.T for name, values in found.items()}

    def _of(self, values: Callable[[Tensor], np.ndarray], place: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
        """Compute the wanted quantities; `values` evaluates modes as an array (components, ...) at the coordinates x,
        y, z of `place`."""
        given, unit = {name: values(modes) for name, modes in self._modes.items()}, self.medium.unit
        added: np.ndarray | float = 0.0  # of the strain that the modes lack
        if "gradient" in given and self.medium.share < 1:
            added = (1 / self.medium.share - 1) * squared(strain_of(given["gradient"]))
        if self.medium.background is not None:
            self._add_background(given, place)
        velocity = given["velocity"]
        found = {"velocity": unit * velocity}
        if "gradient" in given:
            a, strain = given["gradient"].reshape(3, 3, *velocity.shape[1:]), strain_of(given["gradient"])
            square = np.einsum("ij...,jk...->ik...", a, a)
            rate = 2 * self.medium.viscosity * (squared(strain) + added)
            found |= {"gradient": given["gradient"], "strain": strain, "dissipation": unit**2 * rate,
                      "vorticity": np.stack([a[2, 1] - a[1, 2], a[0, 2] - a[2, 0], a[1, 0] - a[0, 1]]),
                      "q": -np.einsum("ii...->...", square)[None] / 2,
                      "r": -np.einsum("ij...,ji...->...", square, a)[None] / 3}
        if "pressure" in given:
            found |= {"pressure": self.medium.density * unit**2 * given["pressure"],
                      "acceleration": unit * given["acceleration"]}
        return {name: found[name] for name in self.wanted}

    def _add_background(self, given: dict[str, np.ndarray], place: Sequence[np.ndarray]) -> None:
        given["velocity"] += self.medium.background.at(*place)
        if "gradient" in given:
            given["gradient"] += self.medium.background.gradient.reshape(9, *[1] * (given["gradient"].ndim - 1))
        if "pressure" in given:
            given["pressure"] += self._steady.pressure(*place)
            given["acceleration"] += self._steady.acceleration(*place)


def strain_of(gradient: np.ndarray) -> np.ndarray:
    """Return S_ij (6, ...), ij = xx, yy, zz, xy, xz, yz, of a gradient du_i/dx_j (9, ...), row by row."""
    return np.stack([(gradient[3 * i + j] + gradient[3 * j + i]) / 2 for i, j in SYMMETRIC])


def squared(strain: np.ndarray) -> np.ndarray:
    """Return S_ij S_ij (1, ...) of a strain (6, ...)."""
    return (strain[:3]**2 + 2 * strain[3:]**2).sum(0)[None]


def errors_of(modes: Tensor, tracers: Tracers, grid: FourierGrid, truth: GroundTruth, frame: int) -> dict[str, float]:
    """Return the `relative_error` at a frame: `velocity_error` and `gradient_error` of the filtered velocity.

    The ground truth must hold a field at this frame. Collective.
    """
    slab = SlabDecomposition(grid.decomposition.comm, BOX_LENGTH, truth.fields.cells)
    target = SpectralGrid(slab, cutoff=(slab.planes - 1) // 2)
    exact = truth.planes(truth.fields, truth.field_frames.index(frame), "velocity", slab)
    given = modes if tracers.filtered else modes * grid.filter_transfer(tracers.filter_width)
    own = target.backward(regrid(grid.spectral, target, as_numpy(given.resolve_conj())))
    slopes = [np.concatenate([target.backward(target.gradient(component)) for component in target.forward(field)])
              for field in (own, exact)]

    def rows(planes: np.ndarray) -> Tensor:
        return torch.from_numpy(planes.reshape(len(planes), -1).T)

    return {f"{name}_error": relative_error(slab.comm, rows(made - true), fluctuations(slab.comm, rows(true)))
            for name, (made, true) in {"velocity": (own, exact), "gradient": slopes}.items()}
