"""One variant of a comparison: its run directory, what it shares with others, and how long its steps take."""

from __future__ import annotations

import logging
import math
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from eddies.errors import UserError
from eddies.io.errors import WriteError, write_error
from eddies.io.hdf5 import open_product, read_attributes
from eddies.io.provenance import product_fingerprint
from eddies.io.run_lock import RunInUse, RunTakenOver
from eddies.io.whole_files import write_files
from eddies.parallel.broadcast import on_first_rank
from eddies.parallel.communicator import Comm
from eddies.parallel.rendezvous import all_arrive
from eddies.pipeline import STAGES, after
from eddies.scene.scene import Scene, SceneError
from eddies.workflows.run_directory.work import Work, find_work

log = logging.getLogger("eddies")

# Lies in every run directory that a comparison has made: in no other does it remove anything.
MARK = "made-by-compare.txt"
MARK_TEXT = "`eddies compare --overwrite` replaces the products in this directory that fit it no longer.\n"
TIMED_STEPS = 6  # at least, in a block that is run for its time alone; a rollout leaves its first two out as warm-up

#: What is run for a variant, where it asks for it: all products but the ground truth.
OWN_STAGES = [stage for stage in after("dns") if stage.product is not None]

# Runs stages of a scene in a run directory, all ranks together, and skips those whose product is there.
RunStages = Callable[[Sequence[str], Scene, Path], None]


@dataclass(frozen=True)
class StepSeconds:
    """Wall seconds of a step: the median of several, and the quartiles."""

    median: float
    low: float
    high: float

    @classmethod
    def of_rollout(cls, attributes: Mapping[str, Any]) -> list[StepSeconds]:
        """The seconds that a rollout has measured of itself; none where it took too few steps."""
        if "seconds_per_step" not in attributes:
            return []
        return [cls(*(attributes[f"seconds_per_step{end}"] for end in ("", "_low", "_high")))]


@dataclass
class VariantRun:
    """A variant on its way: its scene, its run directory and that of its ground truth, and what became of it.

    `blocks` are the times of steps of the blocks that were run for their time alone.
    """

    scene: Scene
    directory: Path
    ground_truth: Path
    failure: str | None = None
    blocks: list[StepSeconds] = field(default_factory=list)

    @property
    def name(self) -> str:
        """Name of the variant, which its scene has as well."""
        return self.scene.name

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages that a variant runs where their product is not shared: all but ground truth and report."""
        return tuple(stage.name for stage in OWN_STAGES if stage.name in self.scene.stages)

    def check_directory(self, ground_truths: Sequence[Path]) -> None:
        """Refuse a run directory in which a comparison would replace what it has not made. Sends nothing.

        Raises SceneError: a ground truth of the comparison is in it, or files of others.
        """
        remedy = "choose another --output or another name"
        for path in ground_truths:
            if path.resolve().is_relative_to(self.directory.resolve()):
                raise SceneError(f'variant "{self.name}": its run directory {self.directory} would be that of the '
                                 f"ground truth, {path}; {remedy}")
        truth = self.directory / "ground_truth.h5"
        made_here = (self.directory / MARK).exists() and (truth.is_symlink() or not truth.exists())
        held = [*self.directory.iterdir()] if self.directory.exists() else []
        # With realisations a run directory stands in that of the variant for each of them.
        if not made_here and not all((entry / MARK).exists() for entry in held):
            raise SceneError(f'variant "{self.name}": its run directory {self.directory} holds files that no '
                             f"comparison has made; {remedy}, or remove the directory")

    def work(self, ranks: int) -> Work:
        """What an earlier comparison left there, for this number of ranks. Sends nothing: one rank calls it."""
        return find_work([stage.name for stage in OWN_STAGES], self.scene, self.directory, ranks)

    def prepare(self, earlier: Sequence[VariantRun], ranks: int) -> None:
        """Make the run directory with links to what is shared: ground truth, kernel, and a model trained before.

        What an earlier comparison left there is kept where it fits the settings and, as for times, this number of
        ranks. Sends nothing: one rank does this.
        """
        self.directory.mkdir(parents=True, exist_ok=True)
        write_files({self.directory / MARK: MARK_TEXT})
        done = self.work(ranks).done
        for stage in OWN_STAGES:
            if stage.name not in done:
                (self.directory / stage.file).unlink(missing_ok=True)
        link(self.ground_truth / "ground_truth.h5", self.directory)
        before = [other.directory for other in earlier]
        self._share("train-kernel", [self.ground_truth, *before])
        self._share("train", before)  # not the base's: what training costs is measured here, for all alike

    def _share(self, stage: str, directories: Sequence[Path]) -> None:
        """Link the product of a stage from the first directory that holds one of the same settings."""
        name = STAGES[stage].file
        if stage in self.stages and not (self.directory / name).exists():
            same = [directory / name for directory in directories
                    if product_fingerprint(directory / name) == self.scene.fingerprint(stage)]
            if same:
                link(same[0], self.directory)

    def attempt(self, errors: Comm, work: Callable[[], None]) -> None:
        """Do what may fail: a failure that all ranks meet is noted, another one ends the job.

        `errors` is a communicator of its own, as ranks that do not know of a failure may wait for a message on others.
        """
        try:
            work()
        except (WriteError, RunInUse, RunTakenOver):  # which is not the variant's
            raise
        except UserError as error:  # of which a variant can fail without ending the comparison
            if not all_arrive(errors):
                raise
            self.failure = str(error)
            if errors.rank == 0:
                log.warning("compare: %s failed: %s", self.name, error)

    def roll_out(self, run_stages: RunStages) -> None:
        """Run all stages whose product is not there."""
        run_stages(self.stages, self.scene, self.directory)

    def time_block(self, comm: Comm, run_stages: RunStages) -> None:
        """Run the first steps once more, for their time alone; not if the rollout went wrong."""
        settings, directory = self.scene.simulation, self.directory / "timing"
        with open_product(comm, self.directory / "rollout.h5", "rollout") as file:
            rollout = read_attributes(file, "rollout")
        if rollout["status"] != "complete":
            return
        frames = math.ceil(TIMED_STEPS * settings.step / settings.frame_interval - 1e-9)
        # Half a frame less than that, as a rollout ends with the first frame at or after its time.
        turnovers = (frames - 0.5) * settings.frame_interval / rollout["eddy_turnover_time"]
        in_directories(comm, lambda: self._share_all(directory))
        block = replace(self.scene, simulation=replace(settings, turnovers=turnovers))
        run_stages(("simulate",), block, directory)
        with open_product(comm, directory / "rollout.h5", "rollout") as file:
            self.blocks += StepSeconds.of_rollout(read_attributes(file, "rollout"))
        in_directories(comm, lambda: shutil.rmtree(directory))

    def _share_all(self, directory: Path) -> None:
        shutil.rmtree(directory, ignore_errors=True)  # left by a comparison that was stopped
        directory.mkdir()
        for name in [STAGES[stage].file for stage in STAGES["simulate"].depends_on]:
            if (self.directory / name).exists():
                link(self.directory / name, directory)


def link(product: Path, directory: Path) -> None:
    """A relative link to a product, under its own name."""
    path = directory / product.name
    path.unlink(missing_ok=True)
    path.symlink_to(os.path.relpath(product.resolve(), directory.resolve()))


def in_directories(comm: Comm, work: Callable[[], object]) -> None:
    """Work in directories that rank 0 does alone; all ranks raise its UserError, or WriteError where it cannot
    write."""
    try:
        on_first_rank(comm, work)
    except OSError as error:
        raise write_error(error.filename, error, f"{error.filename}: cannot be written ({error.strerror}); choose "
                          "another --output") from None
