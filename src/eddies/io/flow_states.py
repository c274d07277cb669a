"""States of a whole flow to start from: of a ground truth, or velocities on a periodic cube from other codes.

Supported layouts of other codes, with arrays [z, y, x] and points from the corner of the cube on:

- cutouts of the Johns Hopkins Turbulence Databases (JHTDB), as pyJHTDB, giverny and givernylocal write them:
  `Velocity_0001`, ... (z, y, x, component), numbered in time, and the points of each axis in `xcoor`, `ycoor` and
  `zcoor`, of a cube of edge 2 pi. The points show whether the cutout is the whole cube.
- files `state_phys*.h5` and `.nc` of fluidsim: `state_phys/vx`, `vy` and `vz` (z, y, x) and the attributes `Lx`, `Ly`,
  `Lz` of `info_simul/params/oper`.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
from mpi4py import MPI

from eddies.io.checksums import open_to_read
from eddies.io.errors import ProductError
from eddies.io.fields import FieldSeries
from eddies.io.hdf5 import open_product
from eddies.io.provenance import read_provenance
from eddies.parallel.broadcast import on_all_ranks, on_first_rank

CUTOUT_EDGE = 2 * math.pi
CUTOUT_NAME = re.compile(r"Velocity_(\d+)")
FLUIDSIM_PARAMETERS = "info_simul/params/oper"
PLACE_TOLERANCE = 0.01  # of a grid step: coordinates of cutouts have single precision


class StoredStates(FieldSeries):
    """States of the whole flow in an open ground truth."""

    @property
    def sound_speed(self) -> float | None:
        """Sound speed of the fluid; None if it is incompressible."""
        return tomllib.loads(read_provenance(self.file)["scene"])["flow"].get("sound_speed")


class VelocityCubes:
    """Velocities of another code at one or more times, with the interface of `FieldSeries`.

    `states` has for each time one dataset (z, y, x, component), or three (z, y, x). ProductError if they are not
    velocities on equally many points along each axis.
    """

    variables, sound_speed = ("velocity",), None

    def __init__(self, states: Sequence[Sequence[h5py.Dataset]]) -> None:
        self._states = states
        first = states[0][0]
        self.cells = first.shape[0] if first.shape else 0
        for state in states:
            shape = (self.cells,) * 3 + ((3,) if len(state) == 1 else ())
            for dataset in state:
                if dataset.shape != shape or dataset.dtype.kind != "f" or not self.cells:
                    raise ProductError(f"{_place(dataset)}: has type {dataset.dtype} and shape {dataset.shape}; a "
                                       "velocity with the same number of points along each axis is needed")

    def __len__(self) -> int:
        """Number of states."""
        return len(self._states)

    def read(self, index: int, variable: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Planes start to stop of the velocity, (3, stop - start, y, x); ProductError if they are damaged."""
        return np.concatenate([_read_planes(dataset, start, stop) for dataset in self._states[index]])


@contextmanager
def open_states(comm: MPI.Comm, path: str | Path) -> Iterator[StoredStates | VelocityCubes]:
    """The states of the whole flow in a file; all ranks call it, and if one cannot read it, all raise ProductError.

    A ground truth with tracers has states at a few times, one without has its last state.
    """
    if on_first_rank(comm, lambda: _is_product(Path(path))):
        with open_product(comm, path, "ground_truth") as file:
            yield StoredStates(file, "final" if "fields/final" in file else "unfiltered")
    else:
        with on_all_ranks(comm, lambda: _open(path), ProductError) as file:
            yield on_all_ranks(comm, lambda: _velocity_cubes(file), ProductError)


def _is_product(path: Path) -> bool:
    """Whether a file is a product, or unreadable, which `open_product` reports best."""
    try:
        with open_to_read(path) as file:
            return "kind" in file.attrs
    except OSError:
        return True


def _open(path: str | Path) -> h5py.File:
    try:
        return open_to_read(path)
    except OSError as error:
        raise ProductError(f"{path}: cannot be opened ({error}); put it where all ranks can read it") from None


def _velocity_cubes(file: h5py.File) -> VelocityCubes:
    cutouts = {int(match[1]): file[name] for name in file if (match := CUTOUT_NAME.fullmatch(name))}
    if cutouts:
        return _cutouts([cutouts[number] for number in sorted(cutouts)])
    if all(isinstance(file.get(f"state_phys/v{axis}"), h5py.Dataset) for axis in "xyz"):
        return _fluidsim_state(file)
    raise ProductError(f"{file.filename}: holds no velocity in a known layout: of eddies (ground_truth.h5), of "
                       "a JHTDB cutout (Velocity_0001, ...) or of fluidsim (state_phys/vx, vy, vz); it holds: "
                       f"{', '.join(file) or 'nothing'}")


def _cutouts(datasets: Sequence[h5py.Dataset]) -> VelocityCubes:
    cubes, file = VelocityCubes([[dataset] for dataset in datasets]), datasets[0].file
    step = CUTOUT_EDGE / cubes.cells
    for name in ("xcoor", "ycoor", "zcoor"):
        points = file.get(name)
        if not isinstance(points, h5py.Dataset) or points.shape != (cubes.cells,):
            raise ProductError(f"{file.filename}: holds no {name} with {cubes.cells} points, which would show "
                               "that the cube is whole and periodic; get the cutout with its coordinates")
        where = points[()].astype(np.float64)
        if not np.abs(where - where[0] - step * np.arange(cubes.cells)).max() < PLACE_TOLERANCE * step:
            raise ProductError(f"{file.filename}: {name} goes from {where[0]:.6g} to {where[-1]:.6g} in {len(where)} "
                               "points, which is not the whole periodic cube of edge 2 pi at equal distances; get all "
                               "points of the cube, or every second, fourth, ...")
    return cubes


def _fluidsim_state(file: h5py.File) -> VelocityCubes:
    cubes = VelocityCubes([[file[f"state_phys/v{axis}"] for axis in "xyz"]])
    parameters = file.get(FLUIDSIM_PARAMETERS)
    try:
        edges = [float(parameters.attrs[f"L{axis}"]) for axis in "xyz"]
    except (AttributeError, KeyError, TypeError, ValueError):
        raise ProductError(f"{file.filename}: {FLUIDSIM_PARAMETERS} has no numbers Lx, Ly, Lz, the edges of the box; "
                           "take a file as fluidsim writes it") from None
    if not edges[0] > 0 or not np.allclose(edges, edges[0], rtol=1e-9, atol=0):
        raise ProductError(f"{file.filename}: the box has the edges {', '.join(f'{edge:g}' for edge in edges)}; a "
                           "cube is needed")
    return cubes


def _read_planes(dataset: h5py.Dataset, start: int, stop: int | None) -> np.ndarray:
    """Planes of a vector or of one component, (components, z, y, x)."""
    try:
        values = dataset[start:stop]
    except OSError as error:
        raise ProductError(f"{_place(dataset)}: damaged ({error}); get the file again") from None
    if not np.isfinite(values).all():
        raise ProductError(f"{_place(dataset)}: holds values that are not finite; get the file again")
    return np.moveaxis(values, -1, 0) if values.ndim == 4 else values[None]


def _place(dataset: h5py.Dataset) -> str:
    return f"{dataset.file.filename}: {dataset.name.lstrip('/')}"
