"""Run by test_cli.py under mpirun with DIRECTORY and KIND: `eddies dns`, whose rank 1 ends while its product is open,
by a "mistake" of the user or by "exit"."""

import sys
import time
from pathlib import Path

import eddies.cli
import eddies.workflows.dns
from eddies.io.hdf5 import create_product
from eddies.scene.scene import SceneError


def failing_run(scene, comm, directory, stop):
    with create_product(comm, directory / "ground_truth.h5", "ground_truth", {}):
        if comm.rank == 1:
            (Path(sys.argv[1]) / "refused").write_text(f"{time.time():.6f}")
            if sys.argv[2] == "exit":
                sys.exit(3)
            raise SceneError("no such reactor")
        comm.Barrier()


eddies.workflows.dns.run = failing_run
sys.exit(eddies.cli.main(["dns", "abc", "--output", sys.argv[1]]))
