"""Runs each command on a full disk, a small file system of its own. Takes minutes.

    python tests/validation/full_disk.py [--commands dns,train,...] [--ranks 1,2] [--levels 0.03,0.5,0.95]

Each command gets room for a part of what it writes. It must end with exit code 2 and one line, and leave all products
unchanged. Once there is room, the same command must complete. Linux only: the file system is a tmpfs in a mount
namespace, for which one must be root or have `unshare -Urm`.
"""

import argparse
import hashlib
import os
import resource
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parents[1])]

from eddies.scene.scene import load_scene  # noqa: E402
from mpi_tools.launch import mpi_environment, mpirun_command  # noqa: E402
from tests.small_scene import TINY  # noqa: E402

SMALL = ["flow.cells=16", "flow.viscosity=0.1", "spin_up.turnovers=0.3", "tracers.particles_per_side=8",
         "tracers.field_cells=12", "tracers.frame_interval=0.1", "tracers.field_every=1", "kernel.neighbors=30",
         "kernel.steps=4", "training.steps=6", "training.combined_steps=2", "training.batch=64", "training.frames=3",
         "simulation.step=0.05", "simulation.frame_interval=0.2", "name=small"]
VARIANTS = 'base = "small.toml"\n[variant.learned]\n[variant.no-force]\nsimulation.method = "none"\n'
STAGES = {"dns": "ground_truth.h5", "train-kernel": "kernel.h5", "train": "model.h5", "simulate": "rollout.h5"}
# What each command makes, in a directory.
PRODUCTS = {**{stage: f"run/{file}" for stage, file in STAGES.items()},
            "report": "run/report/index.html", "export": "run/vtkhdf/old", "run": "out/report/index.html"}
TO_A_CHECKPOINT = """
import sys
from importlib import import_module
from pathlib import Path
from mpi4py import MPI
from eddies.parallel.stop import Stopped
from eddies.scene.scene import load_scene
from tests.workflows.stopping import StopAtStep
run = import_module("eddies.workflows." + sys.argv[1]).run
try:
    run(load_scene("small.toml"), MPI.COMM_WORLD, Path("run"), StopAtStep(MPI.COMM_WORLD, 3))
except Stopped:
    sys.exit()
sys.exit("not stopped")
"""
DISK_BYTES, SECONDS = 2**26, 120  # a command that takes longer hangs


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--commands", default=",".join(PRODUCTS))
    parser.add_argument("--ranks", default="1,2")
    parser.add_argument("--levels", default="0.03,0.5,0.95", help="room, as a share of the bytes that a command adds")
    parser.add_argument("--mounted", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if not given.mounted:
        namespace = "-m" if os.geteuid() == 0 else "-Urm"
        os.execvp("unshare", ["unshare", namespace, sys.executable, __file__, "--mounted", *sys.argv[1:]])
    resource.setrlimit(resource.RLIMIT_CORE, (resource.getrlimit(resource.RLIMIT_CORE)[1],) * 2)
    with tempfile.TemporaryDirectory() as folder:
        plenty, disk = Path(folder) / "plenty", Path(folder) / "disk"
        for place in (plenty, disk):
            place.mkdir()
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", disk], check=True)
        try:
            run_all(given.commands.split(","), [int(ranks) for ranks in given.ranks.split(",")],
                    [float(level) for level in given.levels.split(",")], plenty, disk)
        finally:
            subprocess.run(["umount", disk], check=True)


def run_all(commands, rank_counts, levels, plenty, disk):
    """Try all commands; print a line for each trial."""
    write_inputs(plenty)
    assert eddies(1, plenty, "run", "small.toml", "--output", "run").returncode == 0
    for command in commands:
        begin(command, plenty, disk)
        before = shutil.disk_usage(disk).used
        ended = eddies(1, disk, *arguments(command))
        assert ended.returncode == 0, ended.stderr
        needed = shutil.disk_usage(disk).used - before
        if command == "report":  # it is written beside the old one, which it then replaces
            needed = sum(path.stat().st_size for path in (disk / "run/report").rglob("*") if path.is_file())
        for ranks in rank_counts:
            for level in levels:
                faults = trial(command, ranks, int(level * needed), plenty, disk)
                print(f"{command:13} ranks: {ranks}, room for {level:4.0%} of {needed} bytes: "
                      f"{'; '.join(faults) or 'reported, nothing harmed'}", flush=True)
            (disk / "filler").unlink()
            ended = eddies(ranks, disk, *arguments(command))
            done = ended.returncode == 0 and (command == "export" or (disk / PRODUCTS[command]).stat().st_size > 1000)
            if command in ("dns", "train"):
                done = done and "goes on from step" in ended.stdout
            print(f"{command:13} ranks: {ranks}, with room again: {'done' if done else ended.stderr}", flush=True)


def write_inputs(place):
    """Write the scene, and the same with variants."""
    (place / "small.toml").write_text(load_scene(TINY, SMALL).to_toml())
    (place / "variants.toml").write_text(VARIANTS)


def arguments(command):
    """The command line; stages continue from their checkpoints and replace old products."""
    if command in STAGES:
        return [command, "small.toml", "--output", "run", "--checkpoint-minutes", "1e-9", "--overwrite"]
    return [command, "variants.toml", "--output", "out"] if command == "run" else [command, "run"]


def eddies(ranks, place, *words):
    """The ended process of a command, started in a directory."""
    line = mpirun_command(ranks, [sys.executable, "-m", "eddies", *words])
    return subprocess.run(line, cwd=place, env=mpi_environment(ranks), capture_output=True, text=True, timeout=SECONDS)


def begin(command, plenty, disk):
    """Put on the disk what a command needs: earlier products, an old product of its own, and a checkpoint."""
    for path in disk.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    write_inputs(disk)
    if command in STAGES:
        (disk / "run").mkdir()
        for product in list(STAGES.values())[:list(STAGES).index(command)]:
            shutil.copy(plenty / "run" / product, disk / "run")
        if command in ("dns", "train"):
            subprocess.run([sys.executable, "-c", TO_A_CHECKPOINT, command], cwd=disk, check=True,
                           env={**mpi_environment(1), "PYTHONPATH": os.pathsep.join(sys.path)})
    else:
        shutil.copytree(plenty / "run", disk / "run")
    old = disk / PRODUCTS[command]
    old.parent.mkdir(parents=True, exist_ok=True)
    old.write_text("old")


def trial(command, ranks, free, plenty, disk):
    """Run a command with this much room; the faults found."""
    begin(command, plenty, disk)
    before = contents(disk)
    with open(disk / "filler", "wb") as file:
        os.posix_fallocate(file.fileno(), 0, max(shutil.disk_usage(disk).free - free, 1))
    try:
        ended = eddies(ranks, disk, *arguments(command))
    except subprocess.TimeoutExpired:
        return ["hangs"]
    lines = [line for line in ended.stderr.splitlines() if "eddies: error: " in line]
    faults = [f"{word} in stderr" for word in ("Traceback", "Segmentation", "Exception ignored", "MPI_ABORT",
                                               "Logging error") if word in ended.stderr]
    if ended.returncode != 2 or len(lines) != 1 or "bytes wanted" not in lines[0]:
        faults.append(f"exit code {ended.returncode}: {ended.stderr[-3000:]}")
    after = contents(disk)
    faults += [f"{path} is harmed" for path in before if after.get(path) != before[path]]
    faults += [f"{path} is left" for path in after if ".partial" in path or Path(path).name.startswith("core")]
    if command in ("dns", "train") and not list(disk.rglob("checkpoints*/step-*")):
        faults.append("no checkpoint is left")
    return faults


def contents(disk):
    """Hash of every product; checkpoints and notes on the run may change."""
    return {str(path.relative_to(disk)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(disk.rglob("*")) if path.is_file() and "/checkpoints" not in str(path)
            and path.name not in ("filler", "stage_seconds.json", "scene.toml", "learning.png")}


if __name__ == "__main__":
    main()
