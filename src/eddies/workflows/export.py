"""The fields and particles of a run in files for other programs, by series. Rank 0 does the work, the others wait."""

from __future__ import annotations

import logging
from pathlib import Path

from eddies.io.fields import FieldSeries
from eddies.io.hdf5 import File, ProductError, open_product
from eddies.io.lagrangebench import shortcoming, write_dataset
from eddies.io.provenance import read_provenance
from eddies.io.trajectories import Trajectory
from eddies.io.vtkhdf import write_images, write_points
from eddies.parallel.broadcast import on_first_rank
from eddies.parallel.communicator import Comm
from eddies.scene.sections import BOX_LENGTH

log = logging.getLogger("eddies")

PRODUCTS = ("ground_truth", "rollout")


def run(run_directory: Path, output: Path, comm: Comm, layout: str = "vtkhdf") -> None:
    """Write every series of a run directory; all ranks call it.

    With the layout "vtkhdf" a series is the file OUTPUT/PRODUCT-GROUP-NAME.vtkhdf, GROUP being fields or particles;
    with "lagrangebench" one of particles is the directory OUTPUT/PRODUCT-particles-NAME.

    Raises:
        ProductError: on all ranks, if there is no such series, a product is damaged, or a file cannot be written.
    """
    alone = comm.Split(comm.rank)
    try:
        on_first_rank(comm, lambda: _export(run_directory, output, alone, layout))
    except OSError as error:
        raise ProductError(f"{error}; check the files and the directory") from None
    finally:
        alone.Free()


def _export(run_directory: Path, output: Path, alone: Comm, layout: str) -> None:
    written, (export, what, maker) = 0, LAYOUTS[layout]
    for kind in PRODUCTS:
        path = run_directory / f"{kind}.h5"
        if path.exists():
            with open_product(alone, path, kind) as file:
                written += export(file, kind, output)
    if not written:
        raise ProductError(f"{run_directory}: holds no {what}, which would be in "
                           f"{' and '.join(f'{kind}.h5' for kind in PRODUCTS)}; run {maker} first")


def _write_vtkhdf(file: File, kind: str, output: Path) -> int:
    """Write the series of a product; returns how many have been written."""
    provenance, written = read_provenance(file), 0
    for group, reader in (("fields", FieldSeries), ("particles", Trajectory)):
        for name in file.get(group, ()):
            series, path = reader(file, name), output / f"{kind}-{group}-{name}.vtkhdf"
            if not len(series.times):
                log.info("export: %s/%s of %s.h5 has no frames", group, name, kind)
                continue
            if group == "fields":
                write_images(path, series, BOX_LENGTH, provenance)
            else:
                write_points(path, series, provenance)
            log.info("export: %s, %d steps", path, len(series.times))
            written += 1
    return written


def _write_datasets(file: File, kind: str, output: Path) -> int:
    """Write the particles of a product as data sets; returns how many have been written."""
    provenance, written = read_provenance(file), 0
    for name in file.get("particles", ()):
        trajectory, case = Trajectory(file, name), f"{kind}-particles-{name}"
        problem = shortcoming(trajectory)
        if problem:
            log.warning("export: particles/%s of %s.h5 is left out: %s", name, kind, problem)
            continue
        write_dataset(output / case, trajectory, case, provenance)
        log.info("export: %s, %d frames", output / case, len(trajectory.times))
        written += 1
    return written


# What writes a product in a layout, what of it, and where that comes from.
LAYOUTS = {"vtkhdf": (_write_vtkhdf, "fields or particles", "`eddies dns SCENE`"),
           "lagrangebench": (_write_datasets, "particles that make a data set",
                             "`eddies dns SCENE` with a scene that has [tracers]")}
