"""Errors at left-out tracks of public measurements and of a public simulation. A script.

    .venv/bin/pip download flowtracks==1.8.0 --no-deps --no-binary :all:
    tar xzf flowtracks-1.8.0.tar.gz
    .venv/bin/python tests/validation/public_tracks.py guala flowtracks-1.8.0/data/tracers
    git clone https://github.com/RobinBarta/proPTV
    .venv/bin/python tests/validation/public_tracks.py convection proPTV/data/makeData/input

guala: 3D-PTV of turbulence in water between rotating disks (Guala et al. 2008); GPL-3, so it is read and not copied.
convection: tracers of a simulation of thermal convection (proPTV, MIT), with velocities; 4,000 of the 64,000.

Each data set goes through the stage `dns` as tracks of an experiment. Three splits leave out another tenth of the
tracks each. Settings were chosen with the first half of the frames; the table is of the second half, of which a memory
sees the first FRAMES frames. Prints the errors over the rms of the fluctuations, as means over the later half of these
frames: means of the splits, and their standard deviation.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from mpi4py import MPI
from scipy.io import netcdf_file

import eddies
from eddies.io.hdf5 import open_product
from eddies.io.track_files import Tracks
from eddies.scene.scene import load_scene
from eddies.parallel.stop import StopRequest
from eddies.workflows import left_out_tracks
from eddies.workflows.track_source import Source
from eddies.workflows.tracks import with_tracks

FRAMES = {"guala": 40, "convection": 10}
SPLITS = 3
EVERY = 16              # only one of so many tracers of the simulation
SCENE = """
[tracks]
path = "tracks.h5"
volume = "auto"
filtered = false
viscosity = {viscosity}
{noise}
[reconstruction]
fields = ["velocity"]
"""


def measured(folder: Path) -> tuple[Tracks, dict[str, str]]:
    """The tracks of Guala et al. in mm and s, and the lines of the scene."""
    return eddies.read_tracks(folder / "ptv_is.*", frame_rate=500), {"viscosity": "1.0", "noise": 'noise = "auto"'}


def simulated(folder: Path) -> tuple[Tracks, dict[str, str]]:
    """The tracers of the convection, in units of the height of the cell and the free-fall velocity. In the files the
    columns are z, y, x and the velocities in this order."""
    times, rows = [], []
    for path in sorted(folder.glob("PARTICLE_*.nc")):
        with netcdf_file(path, mmap=False) as file:
            times.append(float(file.variables["tprobl"].getValue()))
            rows.append(np.array(file.variables["particles"][::EVERY], float))
            prandtl, rayleigh = (float(file.variables[name].getValue()) for name in ("pr", "gr"))
    time, track = (part.ravel() for part in np.indices((len(rows), len(rows[0]))))
    table = np.concatenate(rows)
    return (Tracks(np.array(times)[time], track, table[:, 2::-1], table[:, 5:2:-1]),
            {"viscosity": f"{(prandtl / rayleigh) ** 0.5}", "noise": ""})


SETS = {"guala": measured, "convection": simulated}


def errors(name: str, tracks: Tracks, lines: dict[str, str], split: int) -> dict[str, float]:
    """Errors of all methods. Another number of the split gives the tracks other ids, and so leaves out other ones."""
    comm, folder = MPI.COMM_WORLD, Path(tempfile.mkdtemp())
    times = tracks.times[len(tracks.times) // 2:][:FRAMES[name]]
    rows = (tracks.time >= times[0]) & (tracks.time <= times[-1])
    ids = tracks.track[rows] + split * (tracks.track.max() + 1)
    eddies.write_tracks(folder / "tracks.h5", tracks.time[rows], ids, tracks.position[rows],
                        None if tracks.velocity is None else tracks.velocity[rows])
    (folder / "scene.toml").write_text(SCENE.format(**lines))
    eddies.run(folder / "scene.toml", stages=["dns"], output=folder / "run", comm=comm)
    scene = with_tracks(load_scene(folder / "scene.toml"), comm)
    left_out_tracks.FRAMES = len(times)
    with open_product(comm, folder / "run/ground_truth.h5", "ground_truth") as file:
        source = Source(scene.tracks, scene.tracers, scene.reconstruction, file, comm)
        return left_out_tracks.errors_at_left_out(scene, source, file, StopRequest(comm)) | {
            "spacing_over_eta": source.spacing / source.scales["kolmogorov_length"]}


def main(name: str, folder: Path) -> None:
    """Print the table of a data set."""
    tracks, lines = SETS[name](folder)
    found = []
    for split in range(SPLITS):
        found.append(errors(name, tracks, lines, split))
        print(found[-1], flush=True)
    for key in found[0]:
        values = [row[key] for row in found]
        print(f"{key:20} {np.mean(values):.3g} ± {np.std(values, ddof=1):.1g}")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
