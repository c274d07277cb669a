"""Measures of a rollout: the numbers and small arrays by which it is compared with its truth, in measures.h5."""

import json
import logging
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from eddies.analysis.rollout_measures import Tables, measures, of_model
from eddies.analysis.velocity_gradients import Invariants
from eddies.io.errors import ProductError, WriteError
from eddies.io.hdf5 import Table, create_product, in_files, open_product, read_table, write_table
from eddies.io.new_files import set_attributes
from eddies.io.provenance import product_attributes, product_ids, product_provenance, read_json
from eddies.measures import MEASURES
from eddies.parallel.broadcast import on_all_ranks, on_first_rank
from eddies.parallel.communicator import Comm
from eddies.particles.devices import prepare_torch
from eddies.pipeline import FILE_OF, STAGES
from eddies.workflows.rollout.measured import StoredRollout, open_rollout

log = logging.getLogger("eddies")

FILE, MADE_FROM = FILE_OF["measures"], ("rollout", "ground_truth", "kernel")
#: Axes of tables, if they are not time alone. Units by name of a column, which "_model" and the like may follow.
AXES = {"velocity_pdfs": "time bin", "acceleration_pdfs": "time bin", "planes": "time y x",
        "invariants": "second third", "invariant_rates": "second third", "spectra": "time wavenumber",
        "flow_spectra": "time wavenumber", "paths_model": "time eigenvalue", "paths_truth": "time eigenvalue",
        "increments_model": "lag", "increments_truth": "lag", "distances": "bin", "forced_spectra": "wavenumber",
        "forced_accelerations": "bin"}
UNITS = {"time": "T", "lag": "T", "wavenumber": "1/L", "energy": "L^2/T^2", "density_rms": "M/L^3", "u_x": "L/T",
         "vorticity": "1/T", "structure": "L^2/T^2", "acceleration_variance": "L^2/T^4"}
Measures = tuple[dict[str, Any], Tables]  # numbers and tables
Task = tuple[str, str, int]  # quantity ("spectra", "invariants" or "planes"), "model" or "truth", frame


def run(directory: Path, comm: Comm, kept: dict[Path, Measures] | None = None) -> None:
    """Measure the rollout of a run directory and write measures.h5; all ranks call it.

    Raises ProductError on all ranks if a product cannot be read, and WriteError if measures.h5 cannot be written. If
    `kept` is given, rank 0 then puts the measures there instead.
    """
    alone = comm.Split(comm.rank)
    try:
        with ExitStack() as files:
            opened = on_all_ranks(comm, lambda: files.enter_context(open_rollout(directory, alone)), ProductError)
            if opened.solver is not None:
                _measure_frames(opened, comm)
            in_files(comm, directory, lambda: _write(directory, opened, alone, comm.size, kept))
    finally:
        alone.Free()


def rollouts_in(directory: Path, comm: Comm) -> list[Path]:
    """Return the directories of all rollouts in a run directory. Raises ProductError if there are none."""
    found = in_files(comm, directory, lambda: sorted(path.parent for path in directory.rglob(STAGES["simulate"].file)))
    if not found:
        raise ProductError(f"{directory}: holds no rollout; run `eddies simulate SCENE` first")
    return found


def update(directory: Path, comm: Comm, kept: dict[Path, Measures] | None = None) -> None:
    """Measure the rollout of a run directory, as `run`, unless measures.h5 fits the products there."""
    if on_first_rank(comm, lambda: not is_current(directory)):
        run(directory, comm, kept)


def is_current(directory: Path) -> bool:
    """Return whether measures.h5 was made from the rollout, the ground truth and the kernel beside it, and by the form
    of this kernel."""
    origin = product_provenance(directory / FILE)
    return bool(origin) and origin["made_from"] == product_ids(directory, MADE_FROM) and (
        origin.get("kernel") == _kernel(directory))


def read(directory: Path, alone: Comm) -> Measures:
    """Return the numbers and the tables in measures.h5, as `measures` makes them, on one rank.

    The numbers also have the keys `attributes`, the attributes of the rollout; `ranks`, those of the rollout;
    `reconstructed_by`, the method by which fields are reconstructed from particles; `filter_width`; and `truth`, the id
    of the ground truth.
    """
    with open_product(alone, directory / FILE, "measures") as file:
        return read_json(file, "numbers"), {name: read_table(file, name) for name in file}


def _kernel(directory: Path) -> str | None:
    """Return the description in kernel.h5, which names its form; None without a kernel. The id of the file does not
    tell another form (`train_kernel.keep_form`)."""
    return product_attributes(directory / FILE_OF["kernel"], "/").get("description")


def _measure_frames(opened: StoredRollout, comm: Comm) -> None:
    """Measure a share of the frames on each rank, and collect the results in the rollout of rank 0; all ranks call it.

    Raises ProductError on all ranks if one of them cannot read a frame.
    """
    def measured(quantity: str, of: str, frame: int) -> Any:
        if quantity == "spectra":
            return opened.spectrum(of, frame)
        fields = opened.fields[of]
        return Invariants.of(fields.gradients(frame)) if quantity == "invariants" else fields.plane(frame)

    prepare_torch("cpu", comm)
    tasks = on_first_rank(comm, lambda: _tasks(opened))
    own = on_all_ranks(comm, lambda: {task: measured(*task) for task in tasks[comm.rank::comm.size]}, ProductError)
    for part in comm.gather(own) or []:
        for (quantity, of, frame), value in part.items():
            getattr(opened.rollout, quantity)[of][frame] = value
    complaints = [words for some in comm.allgather(opened.solver.complaints) for words in some]
    if complaints and comm.rank == 0:
        log.info("measures: %s", complaints[0] + (f" ({len(complaints)} such solves)" if complaints[1:] else ""))


def _tasks(opened: StoredRollout) -> list[Task]:
    """List the measures of single frames. The list is empty if model and truth have no common frame."""
    run = opened.rollout
    try:
        common = run.common
    except ValueError:
        return []
    chosen = {"spectra": run.shown_spectra()}
    if opened.fields:
        every = np.arange(len(common.times))
        chosen |= {"invariants": every, "planes": run.shown(every)}
    tasks = [(quantity, of, int(frame)) for quantity, rows in chosen.items()
             for of, frames in (("model", common.model), ("truth", common.truth)) for frame in frames[rows]]
    if run.forced and opened.stationary is not None:
        tasks += [("spectra", "model", int(frame)) for frame in run.late_spectra()]
        if opened.fields:
            tasks += [("invariants", "truth", 0), *(("invariants", "model", int(frame)) for frame in run.late)]
    return list(dict.fromkeys(tasks))


def _write(directory: Path, opened: StoredRollout, alone: Comm, ranks: int, kept: dict[Path, Measures] | None) -> None:
    rollout = opened.rollout
    try:
        numbers, tables = measures(rollout, opened.stationary)
    except (ValueError, OverflowError) as error:  # too few particles, or values of which there is no PDF
        numbers, tables = {"rollout": of_model(rollout), "accuracy": dict.fromkeys([*MEASURES, "end"]),
                           "not_compared": str(error)}, {}
    numbers |= {"attributes": rollout.attributes, "ranks": opened.provenance["ranks"],
                "reconstructed_by": rollout.reconstructed_by, "filter_width": rollout.reference.get("filter_width"),
                "truth": product_ids(directory, ("ground_truth",)).get("ground_truth")}
    origin = {"scene": opened.provenance.get("scene", ""), "made_from": MADE_FROM, "kernel": _kernel(directory),
              "ranks": ranks}
    text = json.dumps(numbers, default=np.ndarray.tolist)
    try:
        with create_product(alone, directory / FILE, "measures", origin) as file:
            set_attributes(file, {"numbers": text})
            for name, columns in tables.items():
                units = {column: UNITS.get(column, UNITS.get(column.rpartition("_")[0], "")) for column in columns}
                write_table(file, name, Table(columns, AXES.get(name, "time"), units))
    except WriteError:
        if kept is None:
            raise
        kept[directory] = json.loads(text), tables
