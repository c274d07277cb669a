"""What checkpoints survive, in numbers: kills at random moments, bit flips, truncations. A script, some minutes long.

    python tests/validation/survival.py [--kills 200] [--harms 1000]

The simulation that is killed writes a checkpoint before every step, so that most kills fall into a writing. It goes on
from what it finds; when it has ended, its ground truth must be that of a run that was never killed.
"""

import argparse
import logging
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
from mpi4py import MPI

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent / "io"), str(HERE.parent / "workflows"), str(HERE.parents[1])]

from test_checkpoint import fill, harm  # noqa: E402
from test_dns_restart import SPLIT, product  # noqa: E402

from eddies.io.checkpoint import CheckpointDirectory  # noqa: E402
from eddies.scene.scene import load_scene  # noqa: E402

LONGER = [*SPLIT, "tracers.turnovers=1.5"]


def simulation(directory, *options):
    """A process that simulates, on one rank, and not a part of this script's MPI job."""
    overrides = [word for override in LONGER for word in ("--set", override)]
    line = [sys.executable, "-m", "eddies", "dns", "tiny", "--output", str(directory), *overrides, *options]
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("OMPI_", "PMIX_"))}
    return subprocess.Popen(line, env=environment, stdout=subprocess.DEVNULL)


def kills(count, directory, chooser):
    """Kill a simulation so often, at random moments after its first checkpoint; what happened, and how often."""
    fingerprint, seen = load_scene("tiny", LONGER).fingerprint("dns"), Counter()
    whole, run = directory / "whole", directory / "run"
    simulation(whole).wait()
    truth = product(MPI.COMM_SELF, whole)
    while seen["kills"] < count:
        newest, job = last_step(run), simulation(run, "--resume", "--checkpoint-minutes", "1e-9")
        while last_step(run) <= newest and job.poll() is None:
            time.sleep(0.002)
        time.sleep(chooser.random() / 3)
        if job.poll() is None:
            job.kill()
            job.wait()
            seen["kills"] += 1
            seen["in the writing of a checkpoint"] += bool(list(run.glob("checkpoints/step-*.partial")))
            before = last_step(run)
            if (run / "ground_truth.h5").exists():
                seen["after the end, ground truth complete"] += 1
            else:
                saved = CheckpointDirectory(MPI.COMM_SELF, run / "checkpoints", fingerprint).newest()
                seen["newest checkpoint complete"] += saved is not None and saved.content["step"] == before
        if (run / "ground_truth.h5").exists():
            again = product(MPI.COMM_SELF, run)
            seen["runs ended"] += 1
            equal = all(np.array_equal(again[name], truth[name]) for name in truth)
            seen["runs equal to the one never killed"] += equal
            shutil.rmtree(run)
    return seen


def last_step(run):
    """Step of the newest checkpoint that has its name."""
    names = [path.name for path in run.glob("checkpoints/step-*") if path.suffix != ".partial"]
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
        seen["dataset named (state.h5)"] += name == "state.h5" and "dataset" in told.text
        seen["checkpoint before it used"] += saved is not None and saved.content["step"] == 1
    return seen


class Told(logging.Handler):
    """Keeps what is logged."""

    text = ""

    def emit(self, record):
        self.text += record.getMessage()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--harms", type=int, default=1000)
    given, chooser = parser.parse_args(), random.Random(1)
    with tempfile.TemporaryDirectory() as folder:
        for title, seen in (("SIGKILL", kills(given.kills, Path(folder), chooser)),
                            ("bit flips", harms("flip", given.harms, Path(folder) / "flip", chooser)),
                            ("truncations", harms("truncation", given.harms, Path(folder) / "truncation", chooser))):
            print(title, *(f"  {name:36} {number:6}" for name, number in seen.items()), sep="\n")


if __name__ == "__main__":
    main()
