"""Run by test_cli.py under mpirun: `eddies dns`, with a stage that fails while its product is open."""

import sys
import time
from pathlib import Path

import eddies.cli
import eddies.workflows.dns
from eddies.io.hdf5 import create_product
from eddies.scene.scene import SceneError

FAILURES = {"one rank refuses": lambda rank: SceneError("no such reactor") if rank == 1 else None,
            "all ranks refuse": lambda rank: SceneError("no such reactor")}


def failing_run(scene, comm, directory, stop):
    with create_product(comm, directory / "ground_truth.h5", "ground_truth", {}):
        error = FAILURES[sys.argv[1]](comm.rank)
        if error:
            (Path(sys.argv[2]) / "refused").write_text(f"{time.time():.6f}")
            raise error
        comm.Barrier()


eddies.workflows.dns.run = failing_run
sys.exit(eddies.cli.main(["dns", "abc", "--output", sys.argv[2]]))
