"""What the ground truth stores of tracers: id-ordered frames, filtered fields, spectra and reference scales."""

from __future__ import annotations

import numpy as np

from eddies.clock import Clock
from eddies.spectral.spectral_grid import SpectralGrid, restrict
from eddies.flow.statistics import energy_spectrum
from eddies.flow.tracers import TracerParticles
from eddies.io.checkpoint import Checkpoint
from eddies.io.contiguous import Block
from eddies.io.hdf5 import write_table
from eddies.parallel.migration import IdOrder, id_block
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.scene import Tracers
from eddies.workflows.frame_segments import FrameSegments


class TracerFrames:
    """Stores frames of tracers in segments and accumulates the reference scales over all particles and frames.

    Times are counted from the release. Of a `compressible` flow the density is stored as well. The acceleration and
    density rate scales are those of differences between successive frames, along the trajectories.
    """

    def __init__(self, segments: FrameSegments, tracers: TracerParticles, settings: Tracers, released_at: float,
                 compressible: bool) -> None:
        self.segments, self.tracers, self.settings, self.released_at = segments, tracers, settings, released_at
        fine = tracers.field.grid
        slab = SlabDecomposition(fine.decomposition.comm, fine.decomposition.length, settings.cells)
        self.coarse = SpectralGrid(slab, fine.precision, min(fine.cutoff, (settings.cells - 1) // 2))
        self._compressible = compressible
        self._frames = 0
        self._last: dict[str, np.ndarray] = {}
        self._squares = dict.fromkeys(["velocity", "acceleration"], 0.0)
        if compressible:
            self._squares |= dict.fromkeys(["density", "density_rate"], 0.0)
        self._spectra: dict[str, list] = {"time": [], "energy": [], "filtered": []}

    def store(self, state: np.ndarray, clock: Clock) -> None:
        """Store a frame, and every few frames the filtered fields and spectra."""
        time = clock.time - self.released_at
        order = IdOrder(self.coarse.decomposition.comm, self.tracers.columns["id"], self.settings.particles)
        frame = {"position": order.apply(self.tracers.columns["position"]),
                 "velocity": order.apply(self.tracers.columns["velocity"])}
        if self._compressible:
            frame["density"] = order.apply(self.tracers.density(state))
        self.segments.open(clock.steps)
        self.segments.trajectory.append(clock.steps, time, order.start, frame)
        self._accumulate(frame)
        if self._frames % self.settings.field_every == 0:
            self._store_fields(state, time)
        self._frames += 1

    def memory(self) -> tuple[dict[str, float], dict[str, np.ndarray | Block]]:
        """What the rest of the run needs to know of the frames so far, for a checkpoint: numbers and arrays."""
        start, _ = id_block(self.coarse.decomposition.comm, self.settings.particles)
        arrays = {f"last_{name}": Block(values, start, self.settings.particles)
                  for name, values in self._last.items() if name != "position"}
        arrays |= {f"spectra_{name}": np.array(rows) for name, rows in self._spectra.items()}
        return {"frames": self._frames, "squares": self._squares}, arrays

    def restore(self, numbers: dict[str, float], saved: Checkpoint) -> None:
        """Go on from a `memory`, the arrays of which lie in a checkpoint."""
        self._frames, self._squares = numbers["frames"], dict(numbers["squares"])
        block = id_block(self.coarse.decomposition.comm, self.settings.particles)
        names = self._squares.keys() & {"velocity", "density"}
        self._last = {name: saved.read(f"last_{name}", *block) for name in names}
        self._spectra = {name: list(saved.read(f"spectra_{name}")) for name in self._spectra}

    def scales(self) -> dict[str, float]:
        """Reference scales: root mean squares over particles and frames, of one component where there are three."""
        total = self.settings.particles
        frames, pairs = total * self._frames, total * max(self._frames - 1, 1)
        squares = self._squares
        scales = {"velocity_rms": np.sqrt(squares["velocity"] / (3 * frames)),
                  "acceleration_rms": np.sqrt(squares["acceleration"] / (3 * pairs))}
        if self._compressible:
            scales |= {"density_mean": 1.0,
                       "density_rms": np.sqrt(squares["density"] / frames),
                       "density_rate_rms": np.sqrt(squares["density_rate"] / pairs)}
        return scales

    def write_spectra(self, file) -> None:
        """Write the table of DNS and filtered energy spectra."""
        wavenumber = np.arange(len(self._spectra["energy"][0]))
        columns = {name: np.array(rows) for name, rows in self._spectra.items()}
        write_table(file, "spectra", {"wavenumber": wavenumber, **columns})

    def _accumulate(self, frame: dict[str, np.ndarray]) -> None:
        rates = {"velocity": "acceleration", "density": "density_rate"}
        mean = {"velocity": 0.0, "density": 1.0}
        for name in [name for name in rates if name in frame]:  # in the same order on all ranks
            self._add(name, np.sum((frame[name] - mean[name]) ** 2))
            if self._last:
                rate = (frame[name] - self._last[name]) / self.settings.frame_interval
                self._add(rates[name], np.sum(rate**2))
        self._last = frame

    def _add(self, name: str, square: float) -> None:
        # Summed over the ranks at once, so that a run that goes on from a checkpoint adds the same numbers.
        self._squares[name] += float(global_sum(self.coarse.decomposition.comm, square))

    def _store_fields(self, state: np.ndarray, time: float) -> None:
        field = self.tracers.field
        velocity = field.transfer * state[:3]
        modes = {"velocity": velocity}
        if self._compressible:
            modes["density"] = field.density_modes(state)
        planes = {name: self.coarse.backward(restrict(field.grid, self.coarse, part)) for name, part in modes.items()}
        self.segments.fields.append(time, self.coarse.decomposition.start, planes)
        self._spectra["time"].append(time)
        self._spectra["energy"].append(energy_spectrum(field.grid, state[:3])[1])
        self._spectra["filtered"].append(energy_spectrum(field.grid, velocity)[1])
