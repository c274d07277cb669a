"""`eddies export`: write each series of fields or particles of a run to a file for other programs, on rank 0."""

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from eddies.io.fields import FieldSeries
from eddies.io.hdf5 import ProductError, in_files, open_product
from eddies.io.lagrangebench import shortcoming, write_dataset
from eddies.io.provenance import product_attributes, read_provenance
from eddies.io.trajectories import Trajectory
from eddies.io.vtkhdf import write_images, write_points
from eddies.parallel.communicator import Comm
from eddies.scene.sections import BOX_LENGTH

log = logging.getLogger("eddies")

PRODUCTS = ("ground_truth", "reconstruction", "rollout")
WITH_LENGTH = "position", "velocity", "acceleration"  # the columns and variables that are proportional to a length
Provenance = Mapping[str, Any]
Series = Mapping[str, Mapping[str, Any]]  # by group ("fields" or "particles") and name


def run(run_directory: Path, output: Path, comm: Comm, layout: str = "vtkhdf") -> None:
    """Write every series of a run directory; all ranks call it.

    In the layout "vtkhdf" a series is the file OUTPUT/PRODUCT-GROUP-NAME.vtkhdf, where GROUP is fields or particles. In
    a run from measured tracks, all lengths are then in the unit and the axes of the file with the tracks.
    In the layout "lagrangebench" a series of particles is the directory OUTPUT/PRODUCT-particles-NAME.

    Raises:
        ProductError: there is nothing to write, a product is damaged, or a file cannot be written; on all ranks.
    """
    alone = comm.Split(comm.rank)
    try:
        in_files(comm, output, lambda: _export(run_directory, output, alone, layout))
    finally:
        alone.Free()


def _export(run_directory: Path, output: Path, alone: Comm, layout: str) -> None:
    written, unit, corner = 0, 1.0, np.zeros(3)
    if layout == "vtkhdf":
        unit, corner = _file_units(run_directory)
    for kind in PRODUCTS:
        if (run_directory / f"{kind}.h5").exists():
            with _opened(kind, run_directory, alone) as (series, provenance):
                for group, name in ((group, name) for group in series for name in series[group]):
                    case = f"{kind}-{group}-{name}"
                    one = series[group][name]
                    if kind != "reconstruction":  # which has the units of the tracks already
                        one = InFileUnits(one, unit, corner)
                    written += _write(output, case, group, one, provenance, layout == "lagrangebench",
                                      (unit * BOX_LENGTH, -corner))
    if not written:
        what, scene = (("particles that make a data set", " with a scene that has [tracers]")
                       if layout == "lagrangebench" else ("fields or particles", ""))
        raise ProductError(f"{run_directory}: has no {what} in {', '.join(f'{kind}.h5' for kind in PRODUCTS[:-1])} or "
                           f"{PRODUCTS[-1]}.h5; run `eddies dns SCENE`{scene} first")


@contextmanager
def _opened(kind: str, run_directory: Path, alone: Comm) -> Iterator[tuple[Series, Provenance]]:
    """Open the fields and particles of a product, and its provenance. Those of a rollout that are not stored are
    computed when they are read."""
    if kind == "rollout":
        from eddies.workflows.rollout.measured import open_rollout  # needs torch
        with open_rollout(run_directory, alone) as measured:
            particles = measured.particles
            fields = {name: measured.fields[name] for name in particles} if measured.fields else {}
            yield {"fields": fields, "particles": particles}, measured.provenance
    else:
        with open_product(alone, run_directory / f"{kind}.h5", kind) as file:
            yield {group: {name: reader(file, name) for name in file.get(group, ())}
                   for group, reader in (("fields", FieldSeries), ("particles", Trajectory))}, read_provenance(file)


@dataclass(frozen=True)
class InFileUnits:
    """A series with lengths in another unit, and positions from another origin.

    unit : the unit of length of the series, in the new one. corner : position (3,) of the new origin, in the new unit.
    """

    series: Any
    unit: float
    corner: np.ndarray

    def __getattr__(self, name: str) -> Any:
        return getattr(self.series, name)

    def read(self, frame: int, column: str, *rows: int) -> np.ndarray:
        """Read a column or variable as the series does."""
        values = self.series.read(frame, column, *rows)
        if column not in WITH_LENGTH:
            return values
        shift = self.corner if column == "position" else 0.0
        return (values * self.unit - shift).astype(values.dtype)


def _file_units(run_directory: Path) -> tuple[float, np.ndarray]:
    """Return the run's unit of length in that of the file with the tracks, and the place (3,) of the file's origin in
    the cube; 1 and zeros for a run without tracks."""
    found = (product_attributes(run_directory / "ground_truth.h5", "tracks")
             or product_attributes(run_directory / "reconstruction.h5", "about"))
    return float(found.get("length_unit", 1.0)), np.asarray(found.get("corner", np.zeros(3)))


def _write(output: Path, case: str, group: str, series: Any, provenance: Provenance, data_set: bool,
           cube: tuple[float, np.ndarray]) -> bool:
    """Write the series with the name `case` as a VTKHDF file or, if `data_set`, particles as a LagrangeBench data set.
    `cube` holds the edge and the lower corner of the cube.

    Returns whether it was written.
    """
    if not len(series.times):
        log.info("export: %s is left out: it has no frames", case)
        return False
    if data_set and group == "fields":
        log.info("export: %s is left out: a data set holds particles only", case)
        return False
    if group == "particles" and "position" not in series.columns:
        log.info("export: %s is left out: its rows may be others in each frame", case)
        return False
    if data_set and (problem := shortcoming(series)):
        log.warning("export: %s is left out: %s", case, problem)
        return False
    path = output / (case if data_set else f"{case}.vtkhdf")
    if data_set:
        write_dataset(path, series, case, provenance)
    elif group == "fields":
        write_images(path, series, *cube, provenance)
    else:
        write_points(path, series, provenance)
    log.info("export: %s, %d frames", path, len(series.times))
    return True
