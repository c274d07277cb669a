"""What a full disk does to each command, on a small file system of its own: a script, some minutes long.

    python tests/validation/full_disk.py [--commands dns,train,...] [--ranks 1,2] [--levels 0.03,0.5,0.95]

Each command is run with room for a part of what it writes. It has to end with exit code 2 and one line, without a core
file, and to leave everything as it was; once there is room, the same command has to come to its end. Linux:
the file system is a tmpfs in a mount namespace, for which one has to be root or to have `unshare -Urm`.
"""

import argparse
import hashlib
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
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
VARIANTS = """
base = "small.toml"
[variant.learned]
[variant.no-force]
simulation.method = "none"
"""
STAGES = {"dns": "ground_truth.h5", "train-kernel": "kernel.h5", "train": "model.h5", "simulate": "rollout.h5"}
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
COMMANDS = (*STAGES, "report", "export", "run")
DISK_BYTES = 2**26
SECONDS = 120  # for a command: a hang is longer


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--commands", default=",".join(COMMANDS))
    parser.add_argument("--ranks", default="1,2")
    parser.add_argument("--levels", default="0.03,0.5,0.95", help="of the bytes that a command adds with room")
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
    """Try all commands; the table goes to standard output, line by line."""
    write_inputs(plenty)
    assert eddies(1, plenty, "run", "small.toml", "--output", "run").returncode == 0
    for command in commands:
        needed = added_bytes(command, plenty, disk)
        for ranks in rank_counts:
            for level in levels:
                faults = trial(command, ranks, int(level * needed), plenty, disk)
                print(f"{command:13} ranks: {ranks}, room for {level:4.0%} of {needed} bytes: "
                      f"{'; '.join(faults) or 'told, nothing harmed'}", flush=True)
            faults = go_on(command, ranks, disk)
            print(f"{command:13} ranks: {ranks}, once there is room: {'; '.join(faults) or 'done'}", flush=True)


def write_inputs(place):
    """The scene, and the same with variants."""
    (place / "small.toml").write_text(load_scene(TINY, SMALL).to_toml())
    (place / "variants.toml").write_text(VARIANTS)


def arguments(command):
    """The command line of a command."""
    if command in STAGES:
        return [command, "small.toml", "--output", "run", "--checkpoint-minutes", "1e-9"]
    return [command, "variants.toml", "--output", "out"] if command == "run" else [command, "run"]


def replacing(command):
    """The same, which goes on from its checkpoint and replaces what is old."""
    return [*arguments(command), *(["--overwrite"] if command in STAGES else [])]


def eddies(ranks, place, *words):
    """The ended process of a command, started in a directory."""
    line = mpirun_command(ranks, [sys.executable, "-m", "eddies", *words])
    return subprocess.run(line, cwd=place, env=mpi_environment(ranks), capture_output=True, text=True, timeout=SECONDS)


def begin(command, plenty, disk):
    """Put on the disk what there is before a command: earlier products, something old in place of its own, and a
    checkpoint if it makes any."""
    for path in disk.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    write_inputs(disk)
    run = disk / "run"
    if command in STAGES:
        run.mkdir()
        for product in STAGES.values():
            if product == STAGES[command]:
                break
            shutil.copy(plenty / "run" / product, run)
        if command in ("dns", "train"):
            subprocess.run([sys.executable, "-c", TO_A_CHECKPOINT, command], cwd=disk, check=True,
                           env={**mpi_environment(1), "PYTHONPATH": os.pathsep.join(sys.path)})
        (run / STAGES[command]).write_text("old")
    else:
        shutil.copytree(plenty / "run", run)
        old = {"report": run / "report/index.html", "export": run / "vtkhdf/old", "run": disk / "out/report/index.html"}
        old[command].parent.mkdir(parents=True, exist_ok=True)
        old[command].write_text("old")


def added_bytes(command, plenty, disk):
    """Bytes that a command adds to the disk where there is room."""
    begin(command, plenty, disk)
    before = shutil.disk_usage(disk).used
    ended = eddies(1, disk, *replacing(command))
    assert ended.returncode == 0, ended.stderr
    if command == "report":  # in place of the one that was there, and beside it until all is written
        return sum(path.stat().st_size for path in (disk / "run/report").rglob("*") if path.is_file())
    return shutil.disk_usage(disk).used - before


def trial(command, ranks, free, plenty, disk):
    """Run a command with so much room; what went wrong."""
    begin(command, plenty, disk)
    before, filler = contents(disk), disk / "filler"
    with open(filler, "wb") as file:
        os.posix_fallocate(file.fileno(), 0, max(shutil.disk_usage(disk).free - free, 1))
    began = time.monotonic()
    try:
        ended = eddies(ranks, disk, *replacing(command))
    except subprocess.TimeoutExpired:
        return ["hangs"]
    faults = complaints(ended)
    after = contents(disk)
    faults += [f"{path} is harmed" for path in before if not may_change(path) and after.get(path) != before[path]]
    faults += [f"{path} is left" for path in after if ".partial" in path or Path(path).name.startswith("core")]
    if command in ("dns", "train") and not any("/step-" in path for path in after):
        faults.append("no checkpoint is left")
    if time.monotonic() - began > SECONDS / 2:
        faults.append("takes long")
    return faults


def go_on(command, ranks, disk):
    """Make room after a trial and run the command again; what went wrong."""
    (disk / "filler").unlink()
    ended = eddies(ranks, disk, *replacing(command))
    whole = ended.returncode == 0 and is_whole(command, disk)
    faults = [] if whole else [f"exit code {ended.returncode}: {ended.stderr}"]
    if command in ("dns", "train") and "continues from step" not in ended.stdout:
        faults.append("begins anew")
    return faults


def complaints(ended):
    """What is wrong with how a command ended, and with its words."""
    told = [line for line in ended.stderr.splitlines() if "eddies: error: " in line]
    wrong = [word for word in ("Traceback", "Segmentation", "Exception ignored", "MPI_ABORT", "Logging error")
             if word in ended.stderr]
    faults = [f"{word} in stderr" for word in wrong]
    if ended.returncode != 2:
        faults.append(f"exit code {ended.returncode}: {ended.stderr[-3000:]}")
    if len(told) != 1 or "bytes wanted" not in told[0] or " free" not in told[0]:
        faults.append(f"told {told}")
    return faults


def contents(disk):
    """Hash of every file."""
    return {str(path.relative_to(disk)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(disk.rglob("*")) if path.is_file() and path.name != "filler"}


def may_change(path):
    """Whether a file is none of the products: of the newest checkpoints, the oldest make room."""
    return "/checkpoints" in path or path.endswith(("stage_seconds.json", "scene.toml", "learning.png"))


def is_whole(command, disk):
    """Whether a command has left what it makes."""
    if command in STAGES:
        return (disk / "run" / STAGES[command]).stat().st_size > 1000
    if command == "export":
        return len(list((disk / "run/vtkhdf").glob("*.vtkhdf"))) > 2
    page = disk / ("out" if command == "run" else "run") / "report/index.html"
    return "</html>" in page.read_text() and all(
        row["status"] == "complete" for row in (json.loads((page.parent / "variants.json").read_text())["rows"]
                                                if command == "run" else ()))


if __name__ == "__main__":
    main()
