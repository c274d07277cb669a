"""Trajectories as a data set for learned particle simulators, in the layout of LagrangeBench.

Layout: Toshev et al., NeurIPS 2023, Datasets and Benchmarks. A directory holds train.h5, valid.h5 and test.h5, each
with a trajectory `00000` of consecutive frames, and metadata.json. Velocities and accelerations are first and second
differences of positions between frames, so they have the unit of length.
"""

import json
import math
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from eddies.io.new_files import create_export, write_files
from eddies.io.trajectories import Trajectory

SPLITS = ("train", "valid", "test")
FRAMES_OF_A_SPLIT = 3  # the smallest number, because an acceleration needs three frames
FLUID = 0  # the type of all particles
CONNECTIVITY = 1.45  # radius of pairs in the data sets of LagrangeBench, divided by the mean distance of particles
# A standard deviation below this fraction of the edge, the rounding of positions in single precision, is stored as 1,
# because LagrangeBench divides by it.
SMALLEST_DEVIATION = float(np.finfo(np.float32).eps)


def split_frames(frames: int) -> list[int]:
    """Return the numbers of frames for train, valid and test, about 2 : 1 : 1 as in LagrangeBench."""
    held_out = math.ceil(frames / 4)
    return [frames - 2 * held_out, held_out, held_out]


def shortcoming(trajectory: Trajectory) -> str | None:
    """Return why a trajectory cannot become a data set; None if it can."""
    times = trajectory.times
    if min(split_frames(len(times))) < FRAMES_OF_A_SPLIT:
        return f"it has {len(times)} frames, too few for three parts of at least {FRAMES_OF_A_SPLIT}"
    intervals = np.diff(times)
    if not np.allclose(intervals, intervals.mean(), rtol=1e-6, atol=0):
        return "its frames are not at equal intervals"
    if not np.isfinite(trajectory.read(len(times) - 1, "position")).all():
        return "it ends with positions that are not finite"
    return None


def write_dataset(directory: Path, trajectory: Trajectory, case: str, provenance: Mapping[str, Any]) -> None:
    """Write three consecutive parts of a trajectory as a data set with the name `case`; on one rank. `shortcoming` of
    the trajectory must be None. ProductError if a file cannot be written; existing files are then unchanged.
    """
    total, start, moments = trajectory.total, 0, []
    lengths = split_frames(len(trajectory.times))
    with ExitStack() as files:
        for split, frames in zip(SPLITS, lengths):
            layout = {"00000/position": ((frames, total, 3), np.float32), "00000/particle_type": ((total,), np.int32)}
            file = files.enter_context(create_export(directory / f"{split}.h5", layout, provenance))
            file["00000/particle_type"][:] = FLUID
            moments.append(_copy_frames(trajectory, start, file["00000/position"]))
            start += frames
        about = _metadata(trajectory, lengths) | _statistics(np.array(moments), trajectory.length)
        write_files({directory / "metadata.json": json.dumps(
            {"case": case, **about, "provenance": dict(provenance)}, indent=1)})


def _copy_frames(trajectory: Trajectory, start: int, positions: h5py.Dataset) -> np.ndarray:
    """Fill `positions` with the frames from number `start` on. Returns an array (2, 2, 3), whose axes are velocity or
    acceleration, mean or mean square, and component."""
    length, sums, before, velocity_before = trajectory.length, np.zeros((2, 2, 3)), None, None
    for row in range(len(positions)):
        stored = trajectory.read(start + row, "position").astype(np.float32)
        stored[stored >= length] = 0  # float32 may round up to the edge
        positions[row] = stored
        position = stored.astype(np.float64)
        if before is not None:
            velocity = position - before
            velocity -= length * np.rint(velocity / length)
            sums[0] += velocity.mean(axis=0), (velocity**2).mean(axis=0)
            if velocity_before is not None:
                acceleration = velocity - velocity_before
                sums[1] += acceleration.mean(axis=0), (acceleration**2).mean(axis=0)
            velocity_before = velocity
        before = position
    return sums / np.array([len(positions) - 1, len(positions) - 2])[:, None, None]


def _statistics(moments: np.ndarray, length: float) -> dict[str, list[float]]:
    """Return the means and standard deviations of velocity and acceleration, by their names in metadata.json. `moments`
    (parts, 2, 2, 3) holds the result of `_copy_frames` for each part, and `length` is the edge of the box."""
    statistics = {}
    for name, (mean, square) in zip(("vel", "acc"), moments.mean(axis=0)):
        deviation = np.sqrt(np.maximum(square - mean**2, 0))
        statistics[f"{name}_mean"] = mean.tolist()
        statistics[f"{name}_std"] = np.where(deviation < SMALLEST_DEVIATION * length, 1.0, deviation).tolist()
    return statistics


def _metadata(trajectory: Trajectory, lengths: list[int]) -> dict[str, Any]:
    times, length = trajectory.times, trajectory.length
    distance, duration = length / trajectory.total ** (1 / 3), float(times[-1] - times[0])
    counts = {f"sequence_length_{split}": frames - 1 for split, frames in zip(SPLITS, lengths)}  # steps, not frames
    counts |= {f"num_trajs_{split}": 1 for split in SPLITS}
    return {"solver": "eddies", "dim": 3, "dx": distance, "dt": duration / (len(times) - 1), "write_every": 1,
            "t_end": duration, **counts, "num_particles_max": trajectory.total,
            "periodic_boundary_conditions": [True] * 3, "bounds": [[0.0, length]] * 3,
            "default_connectivity_radius": CONNECTIVITY * distance}
