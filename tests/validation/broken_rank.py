"""A small `eddies dns` whose rank 1 fails in the middle of its work; test_broken_ranks.py runs it under mpirun.

    broken_rank.py PLACE KIND DIRECTORY

Every rank leaves its process id in DIRECTORY; rank 1 leaves the time, right before it fails.
"""

import os
import signal
import sys
import time
from pathlib import Path

from mpi4py import MPI

import eddies.cli
import eddies.io.checkpoint
import eddies.io.hdf5
import eddies.parallel.broadcast
import eddies.parallel.halo
import eddies.scene.scene
import eddies.spectral.fourier_passes

# The function that fails, and the number of the failing call. At each place the other ranks wait for this one.
PLACES = {
    "transform": (eddies.spectral.fourier_passes.PlanePass, "to_physical", 50),  # between two transposes
    "halo": (eddies.parallel.halo.PlaneHalo, "forward", 2),
    "product": (eddies.io.hdf5, "frame_bytes", 15),  # before a collective write: the second frame
    "checkpoint": (eddies.io.checkpoint, "write_block", 45),  # half of the second checkpoint is written
}

KINDS = {"RuntimeError": RuntimeError, "MemoryError": MemoryError, "SystemExit": SystemExit,
         "SceneError": eddies.scene.scene.SceneError}

TINY = Path(__file__).parents[1] / "tiny.toml"
SCENE = ["flow.cells=12", "tracers.particles_per_side=5", "tracers.field_cells=8", "spin_up.turnovers=0.01",
         "tracers.turnovers=0.15", "tracers.frame_interval=0.06", "simulation.frame_interval=0.06",
         "tracers.field_every=2", "time.max_step=0.025", "kernel.neighbors=20", "training.batch=9"]


def break_at(owner, name, call, kind, directory):
    """Replace a function of a module or class by one that fails in its `call`-th call."""
    sound, calls = getattr(owner, name), []

    def broken(*arguments):
        calls.append(name)
        if len(calls) == call:
            (directory / "broke").write_text(f"{time.time():.6f}")
            if kind.startswith("SIG"):
                os.kill(os.getpid(), getattr(signal, kind))
            raise KINDS[kind]("reactor leak")
        return sound(*arguments)

    setattr(owner, name, broken)


def main():
    place, kind, directory = sys.argv[1], sys.argv[2], Path(sys.argv[3])
    eddies.parallel.broadcast.PATIENCE = 0.5
    (directory / f"process-{MPI.COMM_WORLD.rank}").write_text(str(os.getpid()))
    if MPI.COMM_WORLD.rank == 1:
        break_at(*PLACES[place], kind, directory)
    overrides = [word for override in SCENE for word in ("--set", override)]
    # A checkpoint before every step, so that steps and their writing alternate.
    often = ["--checkpoint-minutes", "1e-9"] if place == "checkpoint" else []
    return eddies.cli.main(["dns", str(TINY), "--output", str(directory / "run"), *overrides, *often])


sys.exit(main())
