"""Frames of the ground truth: tracers in order of id, filtered fields and spectra, and a few unfiltered flow states."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from eddies.clock import Clock
from eddies.flow.statistics import energy_spectrum
from eddies.flow.tracers import TracerParticles
from eddies.io.frame_segments import FieldLayout, FrameLayout, FrameSegments
from eddies.io.hdf5 import File, write_table
from eddies.parallel.migration import IdOrder
from eddies.parallel.slab import SlabDecomposition
from eddies.scene.scene import BOX_LENGTH, Tracers
from eddies.spectral.spectral_grid import SpectralGrid, regrid
from eddies.workflows.ground_truth.frame_counts import whole_cells


def frame_layout(settings: Tracers, compressible: bool, cutoff: int) -> FrameLayout:
    """The datasets of the ground truth; `cutoff` is the largest wavenumber of the unfiltered flow."""
    columns, variables = {"position": (3,), "velocity": (3,)}, {"velocity": 3}
    if compressible:
        columns, variables = columns | {"density": ()}, variables | {"density": 1}
    return FrameLayout(settings.particles, BOX_LENGTH, {"tracers": columns}, np.float64, {
        "filtered": FieldLayout(settings.cells, variables), "unfiltered": FieldLayout(whole_cells(cutoff), variables)})


class TracerFrames:
    """Stores frames of tracers in segments, and collects the spectra.

    Times count from the release. The density of a `compressible` flow is stored too. `whole` are the numbers of the
    frames, among those with filtered fields, at which the unfiltered flow is stored.
    """

    def __init__(self, segments: FrameSegments, tracers: TracerParticles, settings: Tracers, released_at: float,
                 compressible: bool, whole: Collection[int]) -> None:
        self.segments, self.tracers, self.settings, self.released_at = segments, tracers, settings, released_at
        self.coarse, self._whole = self._grid_of(settings.cells), whole
        self._compressible = compressible
        self._frames = 0
        self._spectra: dict[str, list] = {"time": [], "energy": [], "filtered": []}

    def store(self, state: np.ndarray, clock: Clock) -> None:
        """Store a frame, and every `field_every` frames the filtered fields and spectra."""
        time = clock.time - self.released_at
        order = IdOrder(self.coarse.decomposition.comm, self.tracers.columns["id"], self.settings.particles)
        frame = {"position": order.apply(self.tracers.columns["position"]),
                 "velocity": order.apply(self.tracers.columns["velocity"])}
        if self._compressible:
            frame["density"] = order.apply(self.tracers.density(state))
        self.segments.open(clock.steps)
        self.segments.trajectories["tracers"].append(clock.steps, time, order.start, frame)
        if self._frames % self.settings.field_every == 0:
            self._store_fields(state, time)
            if self._frames in self._whole:
                self._store_whole(state, time)
        self._frames += 1

    def state_dict(self) -> dict[str, int | np.ndarray]:
        """The number of frames and the spectra so far, for a checkpoint."""
        return {"frames": self._frames, **{f"spectra_{name}": np.array(rows) for name, rows in self._spectra.items()}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Inverse of `state_dict`."""
        self._frames = state["frames"]
        self._spectra = {name: list(state[f"spectra_{name}"]) for name in self._spectra}

    def write_spectra(self, file: File) -> None:
        """Write the table of unfiltered and filtered energy spectra."""
        wavenumber = np.arange(len(self._spectra["energy"][0]))
        columns = {name: np.array(rows) for name, rows in self._spectra.items()}
        write_table(file, "spectra", {"wavenumber": wavenumber, **columns})

    def _grid_of(self, cells: int) -> SpectralGrid:
        """A grid of so many cells, with all modes of the flow that it can hold."""
        fine = self.tracers.field.grid
        slab = SlabDecomposition(fine.decomposition.comm, fine.decomposition.length, cells)
        return SpectralGrid(slab, fine.precision, min(fine.cutoff, (cells - 1) // 2))

    def _store_whole(self, state: np.ndarray, time: float) -> None:
        """Store velocity and density on the smallest grid that holds all their modes."""
        fine = self.tracers.field.grid
        grid = self._grid_of(whole_cells(fine.cutoff))
        values = grid.backward(regrid(fine, grid, state))
        planes = {"velocity": values[:3]} | ({"density": np.exp(values[3:])} if self._compressible else {})
        self.segments.fields["unfiltered"].append(time, grid.decomposition.start, planes)

    def _store_fields(self, state: np.ndarray, time: float) -> None:
        field = self.tracers.field
        velocity = field.transfer * state[:3]
        modes = {"velocity": velocity}
        if self._compressible:
            modes["density"] = field.density_modes(state)
        planes = {name: self.coarse.backward(regrid(field.grid, self.coarse, part)) for name, part in modes.items()}
        self.segments.fields["filtered"].append(time, self.coarse.decomposition.start, planes)
        self._spectra["time"].append(time)
        self._spectra["energy"].append(energy_spectrum(field.grid, state[:3])[1])
        self._spectra["filtered"].append(energy_spectrum(field.grid, velocity)[1])
