"""Kills stages at random moments and checks that their checkpoints survive. Takes minutes.

    python tests/validation/survival.py [--kills 200] [--stages dns train-kernel simulate] [--ranks 1]

After each SIGKILL the newest checkpoint must be complete, and the stage continues from it. At its end the product must
equal that of a run that was never killed. Prints what happened, and how often.
"""

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import h5py
import numpy as np
from mpi4py import MPI

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent / "workflows"), str(HERE.parents[1])]

from test_dns import SPLIT  # noqa: E402
from test_train import SHORT  # noqa: E402

from eddies.io.checkpoint import CheckpointDirectory  # noqa: E402
from eddies.pipeline import STAGES  # noqa: E402
from eddies.scene.scene import load_scene  # noqa: E402
from eddies.workflows.run_directory.fingerprints import stage_fingerprint  # noqa: E402
from mpi_tools.launch import mpi_environment, mpirun_command  # noqa: E402
from tests.small_scene import TINY  # noqa: E402

LEARNING = [*SHORT, "kernel.steps=40", "training.steps=3", "training.combined_steps=1", "simulation.turnovers=1.5",
            "simulation.step=0.025"]
# Overrides of the scene "tiny", and the stages before.
KILLED = {"dns": ([*SPLIT, "tracers.turnovers=1.5"], ()), "train-kernel": (LEARNING, ("dns",)),
          "simulate": (LEARNING, ("dns", "train-kernel", "train"))}


def start(stage, directory, overrides, ranks, *options):
    """A process of a stage, or the mpirun of several ranks; not a part of this script's MPI job."""
    words = [word for override in overrides for word in ("--set", override)]
    line = [sys.executable, "-m", "eddies", stage, TINY, "--output", str(directory), *words, *options]
    environment = {name: value for name, value in mpi_environment(ranks).items()
                   if not name.startswith(("OMPI_COMM", "PMIX_"))}
    return subprocess.Popen(line if ranks == 1 else mpirun_command(ranks, line), env=environment,
                            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL if ranks > 1 else None)


def kill_one(job, ranks, chooser):
    """Kill one rank of a job at random, and wait for the end of all."""
    children = f"/proc/{job.pid}/task/{job.pid}/children"
    processes = [job.pid] if ranks == 1 else list(map(int, Path(children).read_text().split()))
    if processes:
        os.kill(chooser.choice(processes), signal.SIGKILL)
    job.wait()


def product(path):
    """All datasets of a product except wall times."""
    found = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: item[()]} if isinstance(item, h5py.Dataset) else {}))
    return {name: values for name, values in found.items() if not name.endswith("seconds_per_step")}


def last_step(checkpoints):
    """Step of the newest named checkpoint."""
    names = [path.name for path in checkpoints.glob("step-*") if path.suffix != ".partial"]
    return max((int(name.removeprefix("step-").removesuffix(".h5")) for name in names), default=-1)


def kills(stage, ranks, count, directory, chooser):
    """Kill a stage `count` times, at random moments after its first checkpoint; what happened, and how often."""
    (overrides, earlier), seen, file = KILLED[stage], Counter(), STAGES[stage].file
    begin, whole, run = directory / "begin", directory / "whole", directory / "run"
    begin.mkdir()
    for before in earlier:
        start(before, begin, overrides, ranks).wait()
    shutil.copytree(begin, whole)
    start(stage, whole, overrides, ranks).wait()
    truth = product(whole / file)
    settings = stage_fingerprint(load_scene(TINY, overrides), stage, STAGES[stage].duration)
    checkpoints = CheckpointDirectory(MPI.COMM_SELF, run / STAGES[stage].checkpoints, settings)
    while seen["kills"] < count:
        if not run.exists():
            shutil.copytree(begin, run)
        newest = last_step(checkpoints.path)
        job = start(stage, run, overrides, ranks, "--checkpoint-minutes", "1e-9")
        while last_step(checkpoints.path) <= newest and job.poll() is None:
            time.sleep(0.002)
        time.sleep(chooser.random() / 3)
        if job.poll() is None:
            kill_one(job, ranks, chooser)
            seen["kills"] += 1
            seen["during the writing of a checkpoint"] += bool(list(checkpoints.path.glob("step-*.partial")))
            if not (run / file).exists():
                saved = checkpoints.newest()
                seen["newest checkpoint complete"] += saved is not None and (
                    saved.content["step"] == last_step(checkpoints.path))
        if (run / file).exists():
            again = product(run / file)
            seen["runs ended"] += 1
            seen["runs equal to the one never killed"] += again.keys() == truth.keys() and all(
                np.array_equal(again[name], truth[name], equal_nan=True) for name in truth)
            shutil.rmtree(run)
    return seen


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=200, help="of each stage")
    parser.add_argument("--stages", nargs="*", choices=KILLED, default=list(KILLED))
    parser.add_argument("--ranks", type=int, default=1, help="of the jobs that are killed")
    given, chooser = parser.parse_args(), random.Random(1)
    with tempfile.TemporaryDirectory() as name:
        for stage in given.stages:
            folder = Path(name) / stage
            folder.mkdir()
            print(stage, dict(kills(stage, given.ranks, given.kills, folder, chooser)), flush=True)


if __name__ == "__main__":
    main()
