"""A rollout in a run directory, the true tracers in its ground truth, and measures of both."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from eddies.analysis.isotropic_turbulence import StationarySpan
from eddies.analysis.rollout import Plane, Rollout, same_times
from eddies.analysis.velocity_gradients import Invariants
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
class ComputedSeries:
    """A series with one column. Each frame is computed by `make` when it is read."""

    times: np.ndarray
    column: str
    make: Callable[[int], np.ndarray]

    @property
    def columns(self) -> tuple[str]:
        """The name of the column."""
        return (self.column,)

    def read(self, frame: int, column: str) -> np.ndarray:
        """Compute a frame; `column` is the only column."""
        return self.make(frame)


#: A series without frames, in place of the true tracers if there is no ground truth.
NOTHING = ComputedSeries(np.zeros(0), "velocity", lambda frame: np.zeros((0, 3)))


class OnDemand(dict):
    """A dict from frames to the values of a function. Each value is computed once, when it is first used."""

    def __init__(self, measure: Callable[[int], Any]) -> None:
        super().__init__()
        self._measure = measure

    def __missing__(self, frame: int) -> Any:
        self[frame] = found = self._measure(frame)
        return found


@dataclass(frozen=True)
class MeasuredRollout:
    """An open rollout on one rank. Its measures are made when they are first used, and kept.

    Parameters
    ----------
    rollout : the rollout and its truth.
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
        """The particles of "model" and "truth", by these names; particles without frames are left out."""
        return {name: run for name, run in (("model", self.rollout.model), ("truth", self.rollout.truth))
                if len(run.times)}

    @property
    def exported(self) -> dict[str, dict[str, Any]]:
        """The series to export: a dict with the keys "fields" and "particles". Each value maps "model" and "truth" to a
        series.

        Without a kernel, there are no fields, and the particles have no velocity gradients.
        """
        if not self.fields:
            return {"fields": {}, "particles": self.particles}
        fields = {name: self.fields[name] for name in self.particles}
        return {"fields": fields,
                "particles": {name: WithGradients(run, fields[name]) for name, run in self.particles.items()}}

    @property
    def groups(self) -> dict[str, Any]:
        """The series that `open_run` adds to the stored ones. They have names like those of groups in a product."""
        found: dict[str, Any] = {f"particles/{name}": run for name, run in self.particles.items() if name != "model"}
        for name, run in self.particles.items():
            if self.solver is not None:
                found[f"spectra_of_{name}"] = ComputedSeries(run.times, "energy",
                                                             self.rollout.spectra[name].__getitem__)
            if self.fields:
                found[f"fields/{name}"] = self.fields[name]
                found[f"gradients/{name}"] = ComputedSeries(run.times, GRADIENT, self.fields[name].gradients)
        return found


@contextmanager
def open_rollout(directory: Path, alone: Comm) -> Iterator[MeasuredRollout]:
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
            yield MeasuredRollout(Rollout(attributes, model, NOTHING, {}, {}, {}, None, **tables,
                                          without_truth=missing), provenance, {})
            return
        ground = GroundTruth(truth_file, alone)
        truth = TrueParticles(ground.trajectory, attributes["start_time"], model.times)
        both, fields, words = {"model": model, "truth": truth}, {}, ""
        if (directory / "kernel.h5").exists():
            slab = SlabDecomposition(alone, model.length, ground.fields.cells)
            form = load_form(alone, directory / "kernel.h5", ground.scales)
            fields, words = {name: ReconstructedFields(run, form, slab) for name, run in both.items()}, form.words
        solver = ParticleSpectra(ground.scales, model.length, alone)
        spectra = {name: OnDemand(lambda frame, name=name: solver.of(both[name], frame, name)) for name in both}
        invariants = {name: OnDemand(lambda frame, own=own: Invariants.of(own.gradients(frame)))
                      for name, own in fields.items()}
        planes = {name: OnDemand(lambda frame, own=own: Plane(*own.plane(frame))) for name, own in fields.items()}
        rollout = Rollout(attributes, model, truth, read_table(truth_file, "spectra"), ground.reference,
                          spectra, invariants or None, planes or None, **tables, reconstructed_by=words)
        span = None
        if "stationary" in truth_file:
            with suppress(ProductError):  # the report says that the span is too short
                span = read_stationary_span(truth_file)
        yield MeasuredRollout(rollout, provenance, fields, solver, span)
