"""`eddies export`: write each series of fields or particles of a run to a file for other programs, on rank 0."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from eddies.io.fields import FieldSeries
from eddies.io.hdf5 import ProductError, in_files, open_product
from eddies.io.lagrangebench import shortcoming, write_dataset
from eddies.io.provenance import read_provenance
from eddies.io.trajectories import Trajectory
from eddies.io.vtkhdf import write_images, write_points
from eddies.parallel.communicator import Comm
from eddies.scene.sections import BOX_LENGTH

log = logging.getLogger("eddies")

PRODUCTS = ("ground_truth", "reconstruction", "rollout")
Provenance = Mapping[str, Any]
Series = Mapping[str, Mapping[str, Any]]  # by group ("fields" or "particles") and name


def run(run_directory: Path, output: Path, comm: Comm, layout: str = "vtkhdf") -> None:
    """Write every series of a run directory; all ranks call it.

    In the layout "vtkhdf" a series is the file OUTPUT/PRODUCT-GROUP-NAME.vtkhdf, where GROUP is fields or particles.
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
    written = 0
    for kind in PRODUCTS:
        if (run_directory / f"{kind}.h5").exists():
            with _opened(kind, run_directory, alone) as (series, provenance):
                for group, name in ((group, name) for group in series for name in series[group]):
                    case = f"{kind}-{group}-{name}"
                    written += _write(output, case, group, series[group][name], provenance, layout == "lagrangebench")
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
            yield measured.exported, measured.provenance
    else:
        with open_product(alone, run_directory / f"{kind}.h5", kind) as file:
            yield {group: {name: reader(file, name) for name in file.get(group, ())}
                   for group, reader in (("fields", FieldSeries), ("particles", Trajectory))}, read_provenance(file)


def _cube_of(series: Any) -> tuple[float, np.ndarray]:
    """Return the edge and the lower corner of the cube. For fields reconstructed from tracks, both are in the unit and
    the axes of the tracks."""
    if isinstance(series, FieldSeries) and "about" in series.file:
        about = series.file["about"].attrs
        return BOX_LENGTH * float(about["length_unit"]), -about["corner"]
    return BOX_LENGTH, np.zeros(3)


def _write(output: Path, case: str, group: str, series: Any, provenance: Provenance, data_set: bool) -> bool:
    """Write the series with the name `case` as a VTKHDF file or, if `data_set`, particles as a LagrangeBench data set.

    Returns whether it was written.
    """
    if not len(series.times):
        log.info("export: %s is left out: it has no frames", case)
        return False
    if data_set and group == "fields":
        log.info("export: %s is left out: a data set holds particles only", case)
        return False
    if group == "particles" and "position" not in series.columns:
        log.info("export: %s is left out: a row is not the same track in all frames", case)
        return False
    if data_set and (problem := shortcoming(series)):
        log.warning("export: %s is left out: %s", case, problem)
        return False
    path = output / (case if data_set else f"{case}.vtkhdf")
    if data_set:
        write_dataset(path, series, case, provenance)
    elif group == "fields":
        write_images(path, series, *_cube_of(series), provenance)
    else:
        write_points(path, series, provenance)
    log.info("export: %s, %d frames", path, len(series.times))
    return True
