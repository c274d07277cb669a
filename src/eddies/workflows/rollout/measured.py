"""The rollout of a run directory and its truth as all have them who read them: what is stored, and what is measured."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from eddies.analysis.rollout import Reconstruction, Rollout
from eddies.analysis.velocity_gradients import Invariants
from eddies.io.hdf5 import ProductError, open_product, read_attributes, read_table
from eddies.io.provenance import read_provenance
from eddies.io.trajectories import IMAGE, Trajectory
from eddies.parallel.broadcast import on_all_ranks
from eddies.parallel.communicator import Comm
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.devices import prepare_torch
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.learned.model import load_form
from eddies.workflows.rollout.particle_measures import (GRADIENT, FieldsOfParticles, ParticleSpectra,
                                                        ReconstructedFields, WithGradients)
from eddies.workflows.rollout.truth_cache import TruthCache

log = logging.getLogger("eddies")

Task = tuple[str, str, int]  # "spectra" or "reconstructions", "model" or "truth", frame


class TrueParticles:
    """The true tracers at the times of a rollout, as its own particles are stored: in single precision, with their
    acceleration, which is the centred difference along the trajectories, and images counted from the first frame.

    Parameters
    ----------
    tracers : of the ground truth, frame by frame.
    start_time : of the rollout. times : of its frames, of which those are left that the tracers have, (m,).
    """

    def __init__(self, tracers: Trajectory, start_time: float, times: np.ndarray) -> None:
        at = start_time + times
        nearest = np.abs(tracers.times[:, None] - at).argmin(axis=0)
        reached = (np.abs(tracers.times[nearest] - at) < 1e-6) & (0 < nearest) & (nearest < len(tracers.times) - 1)
        self._tracers, self.times, self.total, self.length = tracers, times[reached], tracers.total, tracers.length
        #: the frames of the ground truth
        self.frames = nearest[reached]
        self.columns = (*tracers.columns, "acceleration")

    def read(self, frame: int, column: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Rows start to stop of a column, in order of id. ProductError where one is not finite."""
        tracers, at = self._tracers, int(self.frames[frame])
        if column == "acceleration":
            before, after = (tracers.read(at + step, "velocity", start, stop) for step in (-1, 1))
            return ((after - before) / (tracers.times[at + 1] - tracers.times[at - 1])).astype(np.float32)
        values = tracers.read(at, column, start, stop)
        if column == IMAGE:
            return values - tracers.read(int(self.frames[0]), IMAGE, start, stop)
        return values.astype(np.float32)


class NoParticles:
    """The truth of a rollout without its ground truth: no frame."""

    times, columns = np.zeros(0), ()

    def read(self, frame: int, column: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Nothing."""
        raise IndexError(f"frame {frame} of none")


@dataclass(frozen=True)
class Made:
    """What is made of each frame, under one name."""

    times: np.ndarray
    column: str
    make: Callable[[int], np.ndarray]

    @property
    def columns(self) -> tuple[str]:
        """The name."""
        return (self.column,)

    def read(self, frame: int, column: str) -> np.ndarray:
        """That of a frame."""
        return self.make(frame)


class OnDemand(dict):
    """By frame, what a function gives of it; it is asked once."""

    def __init__(self, measure: Callable[[int], Any]) -> None:
        super().__init__()
        self._measure = measure

    def __missing__(self, frame: int) -> Any:
        self[frame] = found = self._measure(frame)
        return found


class MeasuredRollout:
    """An open rollout, for one rank. What is asked of `rollout` is measured then, and once; `measure` does so before,
    with the help of other ranks and of what an earlier run has measured of the truth.

    Parameters
    ----------
    rollout : what is compared. provenance : of its product.
    fields : as they are reconstructed. solver : of spectra. cache : of the truth. None without a kernel or a ground
        truth.
    """

    def __init__(self, rollout: Rollout, provenance: Mapping[str, Any], fields: FieldsOfParticles | None = None,
                 solver: ParticleSpectra | None = None, cache: TruthCache | None = None) -> None:
        self.rollout, self.provenance = rollout, provenance
        self.fields, self._solver, self._cache = fields, solver, cache

    @property
    def particles(self) -> dict[str, Any]:
        """Of "model" and "truth", as far as they are there."""
        return {name: run for name, run in (("model", self.rollout.model), ("truth", self.rollout.truth))
                if len(run.times)}

    @property
    def exported(self) -> dict[str, dict[str, Any]]:
        """Series of "fields" and "particles" by these names, the latter with velocity gradients, where there is a
        kernel."""
        fields, runs = self.fields, self.particles
        if fields is None:
            return {"fields": {}, "particles": runs}
        return {"fields": {name: ReconstructedFields(run, fields) for name, run in runs.items()},
                "particles": {name: WithGradients(run, fields) for name, run in runs.items()}}

    @property
    def groups(self) -> dict[str, Any]:
        """What programs can read of the rollout beside what it has stored, by names as of groups of a product."""
        found: dict[str, Any] = {f"particles/{name}": run for name, run in self.particles.items() if name != "model"}
        for name, run in self.particles.items():
            if self._solver is not None:
                found[f"spectra_of_{name}"] = Made(run.times, "energy", self.rollout.spectra[name].__getitem__)
            if self.fields is not None:
                found[f"fields/{name}"] = ReconstructedFields(run, self.fields)
                found[f"gradients/{name}"] = Made(run.times, GRADIENT,
                                                  lambda frame, run=run: self.fields.gradients(run, frame))
        return found

    def measure(self, comm: Comm, root: int = 0, whole: bool = True, late: bool = False) -> None:
        """Measure what the report shows, `late` spectra of a forced rollout among it, or without `whole` what
        `accuracy` needs, each rank a share of the frames; rank `root` has it then. All ranks call it, each with this
        rollout open. ProductError on all ranks where one of them cannot read a frame."""
        if self._solver is None:
            return
        prepare_torch("cpu", comm)
        tasks = on_all_ranks(comm, lambda: self._tasks(whole, late), ProductError)
        known = self._cache.read() if comm.rank == root else {}
        at = [self._place(task) for task in tasks]
        left = comm.bcast([task for task, place in zip(tasks, at) if place not in known], root)
        own = on_all_ranks(comm, lambda: {task: self._measured(task) for task in left[comm.rank::comm.size]},
                           ProductError)
        gathered = comm.gather(own, root)
        complaints = [words for some in comm.allgather(self._solver.complaints) for words in some]
        if complaints and comm.rank == 0:
            log.info("report: %s", complaints[0] + (", as may others" if complaints[1:] else ""))
        if comm.rank == root:
            found = {task: value for some in gathered for task, value in some.items()}
            for task, place in zip(tasks, at):
                self._keep(task, found[task] if task in found else known[place])
            fresh = {self._place(task): value for task, value in found.items() if task[1] == "truth"}
            if fresh:
                self._cache.write(known | fresh)

    def _tasks(self, whole: bool, late: bool) -> list[Task]:
        """What is to be measured; nothing where nothing is compared."""
        run = self.rollout
        try:
            common = run.common
        except ValueError:
            return []
        last = len(common.times) - 1
        shown = run.shown_spectra() if whole else np.intersect1d(run.spectral(), last)
        frames = {"model": common.model, "truth": common.truth}
        tasks = [("spectra", of, int(frame)) for of in frames for frame in frames[of][shown]]
        if late:
            tasks += [("spectra", "model", int(frame)) for frame in run.late_spectra()]
        if self.fields is not None:
            tasks += [("reconstructions", of, int(frame)) for of in frames
                      for frame in (run.before_broken(of) if whole else frames[of][-1:])]
        return list(dict.fromkeys(tasks))

    def _place(self, task: Task) -> tuple[str, int] | None:
        """Where the cache has a measure of the truth; None of the model."""
        quantity, of, frame = task
        return (quantity, int(self.rollout.truth.frames[frame])) if of == "truth" else None

    def _measured(self, task: Task) -> Any:
        quantity, of, frame = task
        return getattr(self.rollout, quantity)[of][frame]

    def _keep(self, task: Task, value: Any) -> None:
        quantity, of, frame = task
        getattr(self.rollout, quantity)[of][frame] = value


@contextmanager
def open_together(directory: Path, comm: Comm, alone: Comm) -> Iterator[MeasuredRollout]:
    """The rollout of a run directory for each rank of `comm`, by communicators of their own; all ranks call it, and all
    raise the ProductError of one."""
    with ExitStack() as files:
        yield on_all_ranks(comm, lambda: files.enter_context(open_rollout(directory, alone)), ProductError)


@contextmanager
def open_rollout(directory: Path, alone: Comm) -> Iterator[MeasuredRollout]:
    """The rollout of a run directory, for one rank, with the truth of the ground truth there and measured with the
    kernel there, if there are any. ProductError where one of them cannot be read."""
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
            yield MeasuredRollout(Rollout(attributes, model, NoParticles(), model.length, {}, {}, {}, None, **tables,
                                          without_truth=missing), provenance)
            return
        ground = GroundTruth(truth_file, SlabDecomposition(alone, model.length, 1))
        truth = TrueParticles(ground.trajectory, attributes["start_time"], model.times)
        kernel, fields = directory / "kernel.h5", None
        if kernel.exists():
            slab = SlabDecomposition(alone, model.length, ground.fields.cells)
            fields = FieldsOfParticles(load_form(alone, kernel, ground.scales), slab)
        solver = ParticleSpectra(ground.scales, model.length, alone)
        both = {"model": model, "truth": truth}
        spectra = {name: OnDemand(lambda frame, name=name: solver.of(both[name], frame, name)) for name in both}
        reconstructions = None if fields is None else {
            name: OnDemand(lambda frame, run=run: Reconstruction(
                Invariants.of(fields.gradients(run, frame)), *fields.plane(run, frame)))
            for name, run in both.items()}
        rollout = Rollout(attributes, model, truth, model.length, read_table(truth_file, "spectra"), ground.reference,
                          spectra, reconstructions, **tables, reconstructed_by=fields.form.words if fields else "")
        cache = TruthCache(directory / "ground_truth.h5", kernel if fields else None, alone)
        yield MeasuredRollout(rollout, provenance, fields, solver, cache)
