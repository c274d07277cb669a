"""Training and rollout of the published system and of the forms beside it on 1 to 8 ranks, against one rank.

    .venv/bin/python tests/validation/many_ranks.py DIRECTORY

Runs the scene below in DIRECTORY, once for each number of ranks, in double precision. Prints for each variant the
largest difference of a trained parameter, and of a velocity at the end of the rollout, from those on one rank.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np

from mpi_tools.launch import mpi_environment, mpirun_command

SCENE = """
base = "tiny"
flow.cells = 36
tracers.particles_per_side = 24     # slabs of eight ranks are thicker than the radius of interaction
kernel.neighbors = 60
spin_up.turnovers = 0.2
tracers.turnovers = 0.35
kernel.steps = 4
training.frames = 2
training.steps = 6
training.combined_steps = 2
training.precision = "float64"
simulation.precision = "float64"
simulation.step = 0.05
simulation.turnovers = 0.1
[variant.paper]
[variant.local]
model.preset = "local"
[variant.resolved]
model.preset = "resolved"
"""
VARIANTS, MOST = ("paper", "local", "resolved"), 8


def numbers(run: Path, variant: str) -> tuple[np.ndarray, np.ndarray]:
    """Trained parameters, and velocities in the last frame."""
    with h5py.File(run / variant / "model.h5") as model, h5py.File(run / variant / "rollout.h5") as rollout:
        weights = np.concatenate([each[()].ravel() for each in model["weights"].values()])
        return weights, rollout["particles/model/velocity/value"][-1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("directory", type=Path)
    folder = parser.parse_args().directory
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "ranks.toml").write_text(SCENE)
    one = {}
    print("ranks  variant   parameters  velocities")
    for ranks in range(1, MOST + 1):
        run = folder / f"{ranks}"
        command = [sys.executable, "-m", "eddies", "run", str(folder / "ranks.toml"), "--output", str(run), "--quiet"]
        subprocess.run(mpirun_command(ranks, command), env=mpi_environment(ranks), check=True)
        for variant in VARIANTS:
            found = numbers(run, variant)
            of_one = one.setdefault(variant, found)
            apart = [np.abs(here - there).max() / np.abs(there).max() for here, there in zip(found, of_one)]
            print(f"{ranks:5}  {variant:8}  {apart[0]:10.1e}  {apart[1]:10.1e}", flush=True)


if __name__ == "__main__":
    main()
