"""States of a whole flow: Fourier modes in checkpoints, and initial states from a ground truth or from velocities of
other codes on a periodic cube.

Supported layouts of other codes, with arrays [z, y, x] whose first point is the corner of the cube:

- cutouts of the Johns Hopkins Turbulence Databases (JHTDB), as pyJHTDB, giverny and givernylocal write them. The
  velocities are `Velocity_0001` or `velocity_0001`, ... (z, y, x, component), numbered in time. The value -999.9 marks
  points that the database did not deliver. `xcoor`, `ycoor` and `zcoor` hold the coordinates along each axis. They show
  whether the cutout is the whole cube, which has the edge 2 pi.
- files `state_phys*.h5` and `.nc` of fluidsim. The velocities are `state_phys/vx`, `vy` and `vz` (z, y, x). The
  attributes `Lx`, `Ly`, `Lz` of `info_simul/params/oper` are the edges of the box.
"""

import math
import re
import tomllib
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from eddies.io.checkpoint import Block, Checkpoint
from eddies.io.damage import open_to_read
from eddies.io.errors import ContentError, ProductError, read_errors
from eddies.io.fields import FieldSeries
from eddies.io.hdf5 import open_product
from eddies.io.provenance import read_provenance
from eddies.parallel.broadcast import on_all_ranks, on_first_rank
from eddies.parallel.reduction import global_max, global_min, global_sum

CUTOUT_EDGE = 2 * math.pi
CUTOUT_NAME = re.compile(r"[Vv]elocity_(\d+)")
NOT_DELIVERED = -999.9, 9.969209968386869e36  # marks of missing values: of JHTDB, and by default of netCDF
LARGEST_VELOCITY = 1e12  # its square, summed over a grid, fits into single precision
FILL_ATTRIBUTES = "_FillValue", "missing_value"
# The first bytes of files in other formats, with a remedy.
OTHER_FORMATS = {b"CDF": "a netCDF 3 file; convert it with `nccopy -k netCDF-4 OLD NEW`",
                 b"\x93NUMPY": "a NumPy array; store it in HDF5, or read it in a function that [initial] kind names",
                 b"MATLAB 5": "a MATLAB file older than version 7.3; save it with `-v7.3`, in one of the known layouts"}
FLUIDSIM_PARAMETERS = "info_simul/params/oper"
PLACE_TOLERANCE = 0.01  # in grid steps: coordinates of cutouts have single precision


class StoredStates(FieldSeries):
    """States of the whole flow in an open ground truth."""

    @property
    def sound_speed(self) -> float | None:
        """Sound speed of the fluid; None if it is incompressible."""
        return tomllib.loads(read_provenance(self.file)["scene"])["flow"].get("sound_speed")


class VelocityCubes:
    """Velocities of another code at one or more times, with the interface of `FieldSeries`.

    `states` holds, for each time, one dataset (z, y, x, component) or three datasets (z, y, x). ProductError if the
    datasets are not velocities with the same number of points along each axis.
    """

    variables, sound_speed = ("velocity",), None

    def __init__(self, states: Sequence[Sequence[h5py.Dataset]]) -> None:
        self._states = states
        first = states[0][0]
        self.cells = first.shape[0] if first.shape else 0
        for state in states:
            shape = (self.cells,) * 3 + ((3,) if len(state) == 1 else ())
            for dataset in state:
                if dataset.dtype.kind in "iu":
                    raise ProductError(f"{_place(dataset)}: holds integers ({dataset.dtype}), perhaps packed with a "
                                       "scale and an offset; store floating-point numbers, for example with `ncpdq -U`")
                if dataset.shape != shape or dataset.dtype.kind != "f" or not self.cells:
                    raise ProductError(f"{_place(dataset)}: has type {dataset.dtype} and shape {dataset.shape}; a "
                                       "velocity with the same number of points along each axis is needed")

    def __len__(self) -> int:
        """Number of states."""
        return len(self._states)

    def read(self, index: int, variable: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Return planes start, ..., stop - 1 of the velocity, (3, stop - start, y, x). ProductError if one of
        them is damaged."""
        return np.concatenate([_read_planes(dataset, start, stop) for dataset in self._states[index]])

    def check(self, comm: MPI.Comm, index: int, velocity: np.ndarray) -> None:
        """Raise ProductError if the velocity of state `index` is uniform, too large or incomplete; collective.
        `velocity` holds this rank's planes of this state."""
        dataset = self._states[index][0]
        own = [np.ravel(dataset.attrs[name]) for name in FILL_ATTRIBUTES if name in dataset.attrs]
        fills = dict.fromkeys([*NOT_DELIVERED, *(float(value[0]) for value in own
                                                 if value.size and value.dtype.kind == "f" and value[0])])
        for fill in fills:  # in the same order on all ranks
            with np.errstate(over="ignore"):  # the fill value may be too large for half precision
                mark = np.asarray(fill).astype(velocity.dtype)
            if count := int(global_sum(comm, np.count_nonzero(velocity == mark))):
                raise ProductError(f"{_place(dataset)}: {count} values are {fill:.6g}, the mark of points that were "
                                   "not delivered or written; get the file again")
        lowest = global_min(comm, velocity.min(axis=(1, 2, 3), initial=np.inf).astype(np.float64))
        highest = global_max(comm, velocity.max(axis=(1, 2, 3), initial=-np.inf).astype(np.float64))
        if (lowest == highest).all():
            value = ", ".join(f"{component:g}" for component in lowest + 0.0)
            raise ProductError(f"{_place(dataset)}: the velocity is {value} everywhere; a flow that varies is needed")
        if (largest := max(-lowest.min(), highest.max())) > LARGEST_VELOCITY:
            raise ProductError(f"{_place(dataset)}: the largest velocity is {largest:.3g}, more than the limit of "
                               f"{LARGEST_VELOCITY:g}; get the file again, or scale it")


@contextmanager
def open_states(comm: MPI.Comm, path: Path) -> Iterator[StoredStates | VelocityCubes]:
    """Yield the states of the whole flow in a file; collective. If one rank cannot read it, all ranks raise
    ProductError.

    A ground truth with tracers holds states at a few times; one without tracers holds only its last state.
    """
    if on_first_rank(comm, lambda: _is_product(path)):
        with open_product(comm, path, "ground_truth") as file:
            yield StoredStates(file, "final" if "fields/final" in file else "unfiltered")
    else:
        with on_all_ranks(comm, lambda: _open(path), ProductError) as file:
            yield on_all_ranks(comm, lambda: _velocity_cubes(file), ProductError)


def _is_product(path: Path) -> bool:
    """Return whether a file is a product of eddies. ProductError if it is missing or not an HDF5 file."""
    if not path.is_file():
        raise ProductError(f"{path.absolute()}: {'is not a regular file' if path.exists() else 'no such file'}; make "
                           "it with `eddies dns SCENE`, or correct [initial] path, which is searched in the working "
                           "directory and beside the scene")
    with _open(path) as file:
        return "kind" in file.attrs


def _open(path: Path) -> h5py.File:
    try:
        return open_to_read(path)
    except ContentError:
        with open(path, "rb") as file:
            start = file.read(max(map(len, OTHER_FORMATS)))
        found = next((text for mark, text in OTHER_FORMATS.items() if start.startswith(mark)), None)
        if found is None:
            raise
        raise ProductError(f"{path}: is {found}") from None


def _velocity_cubes(file: h5py.File) -> VelocityCubes:
    cutouts = {int(match[1]): name for name in file if (match := CUTOUT_NAME.fullmatch(name))}
    if cutouts:
        return _cutouts([_dataset(file, cutouts[number]) for number in sorted(cutouts)])
    state = file.get("state_phys")
    if isinstance(state, h5py.Group) and all(f"v{axis}" in state for axis in "xyz"):
        return _fluidsim_state(file)
    raise ProductError(f"{file.filename}: holds no velocity in a known layout: of eddies (ground_truth.h5), of "
                       "a JHTDB cutout (velocity_0001, ...) or of fluidsim (state_phys/vx, vy, vz); it holds: "
                       f"{', '.join(file) or 'nothing'}")


def _cutouts(datasets: Sequence[h5py.Dataset]) -> VelocityCubes:
    cubes, file = VelocityCubes([[dataset] for dataset in datasets]), datasets[0].file
    step = CUTOUT_EDGE / cubes.cells
    for name in ("xcoor", "ycoor", "zcoor"):
        points = file.get(name)
        if not isinstance(points, h5py.Dataset) or points.shape != (cubes.cells,) or points.dtype.kind not in "fiu":
            raise ProductError(f"{file.filename}: holds no {name} with {cubes.cells} numbers, which would show "
                               "that the cube is whole and periodic; get the cutout with its coordinates")
        where = points[()].astype(np.float64)
        if abs(where[-1] - where[0] - CUTOUT_EDGE) < PLACE_TOLERANCE * step:
            raise ProductError(f"{file.filename}: {name} goes from {where[0]:.6g} to {where[-1]:.6g}, so that the last "
                               "plane repeats the first; leave out the last plane of each axis")
        if not np.abs(where - where[0] - step * np.arange(cubes.cells)).max() < PLACE_TOLERANCE * step:
            raise ProductError(f"{file.filename}: {name} goes from {where[0]:.6g} to {where[-1]:.6g} in {len(where)} "
                               "points, which are not equally spaced over the whole periodic cube of edge 2 pi; get "
                               "all points of the cube, or every second, fourth, ...")
    return cubes


def _fluidsim_state(file: h5py.File) -> VelocityCubes:
    cubes = VelocityCubes([[_dataset(file, f"state_phys/v{axis}") for axis in "xyz"]])
    parameters = file.get(FLUIDSIM_PARAMETERS)
    try:
        # Newer versions of fluidsim write arrays of one element.
        edges = [float(np.asarray(parameters.attrs[f"L{axis}"]).item()) for axis in "xyz"]
    except (AttributeError, KeyError, TypeError, ValueError):
        raise ProductError(f"{file.filename}: {FLUIDSIM_PARAMETERS} has no numbers Lx, Ly, Lz, the edges of the box; "
                           "use a file as fluidsim writes it") from None
    if not edges[0] > 0 or not np.allclose(edges, edges[0], rtol=1e-9, atol=0):
        raise ProductError(f"{file.filename}: the box has the edges {', '.join(f'{edge:g}' for edge in edges)}; a "
                           "cube is needed")
    return cubes


def _dataset(file: h5py.File, name: str) -> h5py.Dataset:
    """Return the dataset with this name. ProductError if it is something else, or if its values cannot be read."""
    try:
        item = file[name]
    except KeyError as error:
        raise ProductError(f"{file.filename}: {name} is a link to something that is missing ({error.args[0]}); put the "
                           "data there, or copy them into this file") from None
    if not isinstance(item, h5py.Dataset):
        raise ProductError(f"{file.filename}: {name} is a {type(item).__name__.lower()}, not a dataset; get the file "
                           "again")
    folder = Path(file.filename).parent
    for source in item.virtual_sources() if item.is_virtual else ():
        if source.file_name != "." and not any((place / source.file_name).exists() for place in (folder, Path())):
            raise ProductError(f"{_place(item)}: takes its values from {source.file_name}, which is missing; put that "
                               "file beside this one")
    filters = item.id.get_create_plist()
    for code, *_, label in (filters.get_filter(number) for number in range(filters.get_nfilters())):
        if not h5py.h5z.filter_avail(code):
            raise ProductError(f"{_place(item)}: is compressed with {label.decode() or 'a filter'} (number {code}), "
                               "which this HDF5 library lacks; install its plugin and set HDF5_PLUGIN_PATH, or "
                               "recompress the file with `h5repack -f GZIP=4 OLD NEW` where it can be read")
    return item


def _read_planes(dataset: h5py.Dataset, start: int, stop: int | None) -> np.ndarray:
    """Return planes start, ..., stop - 1 of a vector or of one component, (components, z, y, x)."""
    try:
        values = dataset[start:stop]
    except OSError as error:
        raise ProductError(f"{_place(dataset)}: damaged ({error}); get the file again") from None
    if not np.isfinite(values).all():
        raise ProductError(f"{_place(dataset)}: holds values that are not finite; get the file again")
    return np.moveaxis(values, -1, 0) if values.ndim == 4 else values[None]


def _place(dataset: h5py.Dataset) -> str:
    return f"{dataset.file.filename}: {dataset.name.lstrip('/')}"


def read_spectrum(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read ascending wavenumbers k > 0 and energies E(k) >= 0 from a text file with one pair in each line. # begins a
    comment. Only one rank calls this function.

    Raises ProductError if the file holds something else.
    """
    try:
        with read_errors(path), warnings.catch_warnings(action="ignore"):  # numpy warns of an empty file
            table = np.loadtxt(path.read_text(encoding="utf-8").splitlines(), ndmin=2)
    except ValueError as error:
        raise ProductError(f"{path}: holds no spectrum ({error}); write a wavenumber and E(k) in each line") from None
    if table.shape[1] != 2 or not np.isfinite(table).all():
        raise ProductError(f"{path}: has {table.shape[1]} columns, or numbers that are not finite; write a wavenumber "
                           "and E(k) in each line")
    wavenumber, energy = table.T
    if wavenumber[0] <= 0 or (np.diff(wavenumber) <= 0).any() or (energy < 0).any() or (energy > 0).sum() < 2:
        raise ProductError(f"{path}: must have ascending wavenumbers above 0, no energy below 0, and at least two "
                           "energies above 0")
    return wavenumber, energy


def saved_modes(grid: Any, modes: np.ndarray) -> Block:
    """Return the modes (..., kz, ky, kx) of a `SpectralGrid` for a checkpoint. The axis ky is divided among the
    ranks."""
    return Block(modes, int(grid.column_starts[grid.decomposition.rank]), grid.modes, axis=modes.ndim - 2)


def restored_modes(grid: Any, saved: Checkpoint, dimensions: int, name: str = "modes") -> np.ndarray:
    """Return this rank's part of the modes (..., kz, ky, kx) that a checkpoint holds under `name`. `dimensions` is the
    number of dimensions of this array."""
    start, stop = grid.column_starts[grid.decomposition.rank:][:2]
    return saved.read(name, int(start), int(stop), axis=dimensions - 2)
