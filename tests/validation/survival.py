"""What checkpoints survive, in numbers: kills at random moments, bit flips, truncations. A script, some minutes long.

    python tests/validation/survival.py [--kills 200] [--harms 1000] [--stages dns train-kernel simulate] [--ranks 1]

The stage that is killed writes a checkpoint before every step, so that most kills fall into a writing. On several ranks
one of them is killed. The same command goes on from what it finds; when it has ended, its product must be that of a run
that was never killed.
"""

import argparse
import logging
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
from mpi4py import MPI

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent / "io"), str(HERE.parent / "workflows"), str(HERE.parents[1])]

from test_checkpoint import fill, harm  # noqa: E402
from test_dns_restart import SPLIT  # noqa: E402
from test_train_restart import SHORT  # noqa: E402

from eddies.io.checkpoint import CheckpointDirectory  # noqa: E402
from eddies.pipeline import STAGES  # noqa: E402
from eddies.scene.scene import load_scene  # noqa: E402
from eddies.workflows.run_directory.fingerprints import stage_fingerprint  # noqa: E402
from mpi_tools.launch import mpi_environment, mpirun_command  # noqa: E402
from tests.small_scene import TINY  # noqa: E402


@dataclass(frozen=True)
class Killed:
    """A stage to be killed, with what it overrides of the scene "tiny", and the stages before it."""

    stage: str
    overrides: list[str]
    before: tuple[str, ...] = ()
    ranks: int = 1

    def process(self, directory, *options, stage=None):
        """A process of the stage, or of another, or the mpirun of several; not a part of this script's MPI job."""
        overrides = [word for override in self.overrides for word in ("--set", override)]
        line = [sys.executable, "-m", "eddies", stage or self.stage, TINY, "--output", str(directory), *overrides,
                *options]
        environment = {name: value for name, value in mpi_environment(self.ranks).items()
                       if not name.startswith(("OMPI_COMM", "PMIX_"))}
        return subprocess.Popen(line if self.ranks == 1 else mpirun_command(self.ranks, line), env=environment,
                                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL if self.ranks > 1 else None)

    def kill(self, job, chooser):
        """Kill a process of the stage, of several ranks any one, and wait for the end of all."""
        ranks = [job.pid] if self.ranks == 1 else list(map(
            int, Path(f"/proc/{job.pid}/task/{job.pid}/children").read_text().split()))
        if ranks:
            os.kill(chooser.choice(ranks), signal.SIGKILL)
        job.wait()

    def make(self, directory):
        """What the stage starts from."""
        directory.mkdir()
        for stage in self.before:
            self.process(directory, stage=stage).wait()

    def checkpoints(self, directory):
        """Those of the stage in a run directory."""
        fingerprint = stage_fingerprint(load_scene(TINY, self.overrides), self.stage)
        return CheckpointDirectory(MPI.COMM_SELF, directory / STAGES[self.stage].checkpoints, fingerprint)


LEARNING = [*SHORT, "kernel.steps=40", "training.steps=3", "training.combined_steps=1", "simulation.turnovers=1.5",
            "simulation.step=0.025"]
STAGES_KILLED = {each.stage: each for each in (
    Killed("dns", [*SPLIT, "tracers.turnovers=1.5"]),
    Killed("train-kernel", LEARNING, ("dns",)),
    Killed("simulate", LEARNING, ("dns", "train-kernel", "train")),
)}


def product(path):
    """All datasets of a product, but for wall times."""
    found = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: item[()]} if isinstance(item, h5py.Dataset) else {}))
    return {name: values for name, values in found.items() if not name.endswith("seconds_per_step")}


def kills(killed, count, directory, chooser):
    """Kill a stage so often, at random moments after its first checkpoint; what happened, and how often."""
    seen, file = Counter(), STAGES[killed.stage].file
    start, whole, run = directory / "start", directory / "whole", directory / "run"
    killed.make(start)
    shutil.copytree(start, whole)
    killed.process(whole).wait()
    truth = product(whole / file)
    while seen["kills"] < count:
        if not run.exists():
            shutil.copytree(start, run)
        checkpoints = killed.checkpoints(run)
        newest = last_step(checkpoints.path)
        job = killed.process(run, "--checkpoint-minutes", "1e-9")
        while last_step(checkpoints.path) <= newest and job.poll() is None:
            time.sleep(0.002)
        time.sleep(chooser.random() / 3)
        if job.poll() is None:
            killed.kill(job, chooser)
            seen["kills"] += 1
            seen["in the writing of a checkpoint"] += bool(list(checkpoints.path.glob("step-*.partial")))
            before = last_step(checkpoints.path)
            if (run / file).exists():
                seen["after the end, product complete"] += 1
            else:
                saved = checkpoints.newest()
                seen["newest checkpoint complete"] += saved is not None and saved.content["step"] == before
        if (run / file).exists():
            again = product(run / file)
            seen["runs ended"] += 1
            seen["runs equal to the one never killed"] += again.keys() == truth.keys() and all(
                np.array_equal(again[name], truth[name], equal_nan=True) for name in truth)
            shutil.rmtree(run)
    return seen


def last_step(checkpoints):
    """Step of the newest checkpoint that has its name."""
    names = [path.name for path in checkpoints.glob("step-*") if path.suffix != ".partial"]
    return max((int(name.removeprefix("step-")) for name in names), default=-1)


def harms(kind, count, directory, chooser):
    """Harm so many copies of a checkpoint; how often that was found, told and the one before it used."""
    whole, seen, told = fill(MPI.COMM_SELF, directory, [1, 2]).path, Counter(), Told()
    logging.getLogger("eddies").handlers = [told]
    for _ in range(count):
        trial = CheckpointDirectory(MPI.COMM_SELF, directory / "trial", "settings")
        trial.remove()
        shutil.copytree(whole, trial.path)
        name = chooser.choices(("state.h5", "manifest.json"), [3, 1])[0]
        harm(trial.path / "step-00000002" / name, kind, chooser)
        told.text = ""
        saved = trial.newest()
        seen["harms"] += 1
        seen["of state.h5"] += name == "state.h5"
        seen["found, file named"] += f"step-00000002/{name}: " in told.text
        seen["checkpoint before it used"] += saved is not None and saved.content["step"] == 1
    return seen


class Told(logging.Handler):
    """Keeps what is logged."""

    text = ""

    def emit(self, record):
        self.text += record.getMessage()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=200, help="of each stage")
    parser.add_argument("--harms", type=int, default=1000)
    parser.add_argument("--stages", nargs="*", choices=STAGES_KILLED, default=list(STAGES_KILLED))
    parser.add_argument("--ranks", type=int, default=1, help="of the jobs that are killed")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    chooser = random.Random(given.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for stage in given.stages:
            (folder / stage).mkdir()
            killed = replace(STAGES_KILLED[stage], ranks=given.ranks)
            show(f"SIGKILL, {stage}", kills(killed, given.kills, folder / stage, chooser))
        for title, kind in (("bit flips", "flip"), ("truncations", "truncation")):
            show(title, harms(kind, given.harms, folder / kind, chooser))


def show(title, seen):
    """Print what happened, and how often."""
    print(title, *(f"  {name:36} {number:6}" for name, number in seen.items()), sep="\n", flush=True)


if __name__ == "__main__":
    main()
