"""A rollout in a run directory, the true tracers in its ground truth, and fields and spectra of both."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from eddies.analysis.isotropic_turbulence import StationarySpan
from eddies.analysis.rollout import Rollout, same_times
from eddies.io.hdf5 import ProductError, open_product, read_attributes, read_table
from eddies.io.provenance import read_provenance
from eddies.io.trajectories import IMAGE, Trajectory
from eddies.parallel.communicator import Comm
from eddies.parallel.slab import SlabDecomposition
from eddies.workflows.ground_truth.stationary import read_stationary_span
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.learned.model import load_form
from eddies.workflows.rollout.particle_measures import GRADIENT, ParticleSpectra, ReconstructedFields, WithGradients


class TrueParticles:
    """The true tracers at the times of a rollout, in single precision like the particles of the rollout.

    The acceleration is the centred difference of the velocity along trajectories. The column `image` counts how often a
    particle has left the cube along each axis since the first of these times.

    Parameters
    ----------
    tracers : the tracers of the ground truth.
    start_time : time in the ground truth at which the rollout starts.
    times : times of the frames of the rollout since its start, (m,). A time is left out if the tracers have no frame at
        this time, or only their first or last frame.
    """

    def __init__(self, tracers: Trajectory, start_time: float, times: np.ndarray) -> None:
        frames, reached = same_times(tracers.times, start_time + times)
        inner = (0 < frames) & (frames < len(tracers.times) - 1)
        self._tracers, self.total, self.length = tracers, tracers.total, tracers.length
        self.times = times[reached[inner]]
        #: the frames of the ground truth at `times`
        self.frames = frames[inner]
        self.columns = (*tracers.columns, "acceleration")

    def read(self, frame: int, column: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Read rows start, ..., stop - 1 of a column, in order of id. Raises ProductError if a value is not finite."""
        tracers, at = self._tracers, int(self.frames[frame])
        if column == "acceleration":
            before, after = (tracers.read(at + step, "velocity", start, stop) for step in (-1, 1))
            return ((after - before) / (tracers.times[at + 1] - tracers.times[at - 1])).astype(np.float32)
        values = tracers.read(at, column, start, stop)
        if column == IMAGE:
            return values - tracers.read(int(self.frames[0]), IMAGE, start, stop)
        return values.astype(np.float32)


@dataclass(frozen=True)
class StoredRollout:
    """An open rollout on one rank.

    Parameters
    ----------
    rollout : the rollout and its truth, without measures of single frames.
    provenance : provenance of rollout.h5.
    fields : the reconstructed fields of "model" and "truth"; empty if the kernel or the ground truth is missing.
    solver : makes spectra of particles; None without a ground truth.
    stationary : the stationary state of the ground truth; None without one.
    """

    rollout: Rollout
    provenance: Mapping[str, Any]
    fields: Mapping[str, ReconstructedFields]
    solver: ParticleSpectra | None = None
    stationary: StationarySpan | None = None

    @property
    def particles(self) -> dict[str, Any]:
        """The particles of "model" and, if they have frames, those of "truth". With a kernel they have velocity
        gradients."""
        runs = {"model": self.rollout.model, "truth": self.rollout.truth}
        return {name: WithGradients(run, self.fields[name]) if self.fields else run for name, run in runs.items()
                if name == "model" or len(run.times)}

    def spectrum(self, of: str, frame: int) -> np.ndarray:
        """Return the energy spectrum (shells,) of the particles of "model" or "truth" in a frame."""
        return self.solver.of(getattr(self.rollout, of), frame, of)

    def groups(self) -> dict[str, tuple[np.ndarray, dict[str, Callable[[int], np.ndarray]]]]:
        """Return the groups that `open_run` adds to the stored ones, by name: times, and for each column a function
        that returns a frame."""
        found = {}
        for name, run in self.particles.items():
            columns = {column: partial(run.read, column=column) for column in run.columns}
            if self.fields:
                found[f"gradients/{name}"] = run.times, {GRADIENT: columns.pop(GRADIENT)}
                found[f"fields/{name}"] = run.times, {"velocity": partial(self.fields[name].read, variable="velocity")}
            if self.solver is not None:
                found[f"spectra_of_{name}"] = run.times, {"energy": partial(self.spectrum, name)}
            if name == "truth":
                found["particles/truth"] = run.times, columns
        return found


@contextmanager
def open_rollout(directory: Path, alone: Comm) -> Iterator[StoredRollout]:
    """Open the rollout of a run directory on one rank, with its ground truth and kernel if they are there.

    The ground truth is left out if the rollout was made from another one. Raises ProductError if a file cannot be read.
    """
    with ExitStack() as files:
        def opened(kind: str) -> Any:
            return files.enter_context(open_product(alone, directory / f"{kind}.h5", kind))

        file, truth_file, missing = opened("rollout"), None, "ground_truth.h5 is not here"
        provenance = read_provenance(file)
        if (directory / "ground_truth.h5").exists():
            truth_file = opened("ground_truth")
            known = provenance.get("made_from", {}).get("ground_truth")
            if known not in (None, read_provenance(truth_file).get("id")):
                truth_file, missing = None, "rollout.h5 was made from another ground_truth.h5 than the one here"
        attributes, model = read_attributes(file, "rollout"), Trajectory(file, "model")
        tables = {
            "outside_training": read_table(file, "outside_training")["share"] if "outside_training" in file else None,
            "closure": read_table(file, "closure") if "closure" in file else None}
        if truth_file is None:
            nothing = TrueParticles(model, 0.0, np.zeros(0))
            yield StoredRollout(Rollout(attributes, model, nothing, {}, {}, {}, None, **tables, without_truth=missing),
                                provenance, {})
            return
        ground = GroundTruth(truth_file, alone)
        both = {"model": model, "truth": TrueParticles(ground.trajectory, attributes["start_time"], model.times)}
        fields, words, span = {}, "", None
        if (directory / "kernel.h5").exists():
            slab = SlabDecomposition(alone, model.length, ground.fields.cells)
            form = load_form(alone, directory / "kernel.h5", ground.scales)
            fields, words = {name: ReconstructedFields(run, form, slab) for name, run in both.items()}, form.words
        if "stationary" in truth_file:
            with suppress(ProductError):  # the report says that the span is too short
                span = read_stationary_span(truth_file)
        empty = [{"model": {}, "truth": {}} if fields else None for _ in range(2)]
        rollout = Rollout(attributes, *both.values(), read_table(truth_file, "spectra"), ground.reference,
                          {"model": {}, "truth": {}}, *empty, **tables, reconstructed_by=words)
        yield StoredRollout(rollout, provenance, fields, ParticleSpectra(ground.scales, model.length, alone), span)
