"""Measures of a rollout: the same on any number of ranks, and made again when the rollout changes."""

import logging
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

from eddies.io.hdf5 import ProductError, open_product
from eddies.workflows import measure
from eddies.workflows.rollout import particle_measures
from tests.changed_product import changed
from tests.workflows.synthetic_run import write_kernel, write_rollout, write_run


@pytest.fixture
def directory(comm, tmp_path):
    """A synthetic run, forced and with a stationary state."""
    if comm.rank == 0:
        write_run(MPI.COMM_SELF, tmp_path, {"stationary": True}, injection_rate=0.5)
    comm.Barrier()
    return tmp_path


def measured(directory, comm):
    """Measure, and return numbers and tables on all ranks."""
    measure.run(directory, comm)
    found = comm.bcast(measure.read(directory, MPI.COMM_SELF) if comm.rank == 0 else None)
    comm.Barrier()
    return found


@pytest.mark.mpi(2, 3)
def test_ranks_that_share_the_work_find_what_one_finds(comm, directory):
    numbers, tables = measured(directory, comm)
    if comm.rank == 0:
        alone_numbers, alone = measured(directory, MPI.COMM_SELF)
        assert repr(numbers) == repr(alone_numbers)  # as text, in which NaN equals NaN
        assert tables.keys() == alone.keys()
        for name, columns in tables.items():
            assert all(np.array_equal(values, alone[name][key], equal_nan=True) for key, values in columns.items())
    comm.Barrier()


@pytest.mark.mpi(1)
def test_numbers_and_tables_of_a_forced_rollout(comm, directory):
    numbers, tables = measured(directory, comm)
    rollout, accuracy, forced = (numbers[key] for key in ("rollout", "accuracy", "forced"))
    assert rollout["stable"] and numbers["not_compared"] == "" and numbers["ranks"] == 1
    # Both follow from the same particles, by different sums.
    for key, other in (("energy_ratio", "energy_ratio"), ("velocity_error", "velocity_error_end")):
        assert rollout[key] == pytest.approx(accuracy[other], rel=1e-6)
    for key in ("velocity_kl", "acceleration_kl", "qr_kl", "qr_kl_floor", "structure_error", "tetrad_size_error"):
        assert rollout[key] == accuracy[key]
    assert forced["energy"]["model"] > 0 and forced["qr_kl"] > 0
    # Three times of PDFs and spectra, four of planes, and all common frames of the errors.
    assert [len(tables[name]["time"]) for name in ("pdfs", "spectra", "planes", "errors", "model")] == [3, 3, 4, 6, 9]
    for column in ("velocity", "acceleration"):
        assert tables["pdfs"][f"{column}_model"].sum(axis=1) == pytest.approx(1)
        assert tables["pdfs"][f"{column}_kl"][-1] == rollout[f"{column}_kl"]
    assert tables["planes"]["velocity_truth"].dtype == np.float32 and tables["invariant_rates"]["count_model"].sum() > 0
    assert set(tables) >= {"truth", "flow_spectra", "paths_model", "paths_truth", "distances", "invariants",
                           "forced_spectra", "forced_accelerations"}


@pytest.mark.mpi(1)
def test_measures_are_made_again_when_a_product_changes(comm, directory):
    path = directory / "measures.h5"
    measure.update(directory, comm)
    first = path.stat().st_mtime_ns
    measure.update(directory, comm)
    assert path.stat().st_mtime_ns == first
    with open_product(comm, path, "measures") as file:
        assert {"numbers", "provenance"} <= set(file.attrs)
    for change in (lambda: write_rollout(comm, directory, frames=5, status="stopped: here"),
                   lambda: write_kernel(comm, directory, seed=2), (directory / "kernel.h5").unlink):
        change()
        assert not measure.is_current(directory)
        measure.update(directory, comm)
        assert measure.is_current(directory)
    numbers, tables = measure.read(directory, comm)
    assert numbers["rollout"]["status"] == "stopped: here" and numbers["accuracy"]["velocity_error_end"] is None
    assert numbers["rollout"]["qr_kl"] is None and not tables.keys() & {"planes", "invariants"}


@pytest.mark.mpi(1)
def test_a_variant_has_measures_beside_its_rollout(comm, directory):
    variant = directory / "variant"
    variant.mkdir()
    for product in ("ground_truth.h5", "kernel.h5"):
        (variant / product).symlink_to(Path("..") / product)
    write_rollout(comm, variant)
    assert measure.rollouts_in(directory, comm) == [directory, variant]
    assert measured(variant, comm)[0]["truth"] == measured(directory, comm)[0]["truth"] is not None
    with pytest.raises(ProductError, match="holds no rollout"):
        measure.rollouts_in(directory / "report", comm)


@pytest.mark.mpi(1)
def test_a_rollout_without_its_ground_truth_or_with_positions_that_are_not_finite(comm, directory):
    with changed(directory / "rollout.h5") as file:
        file["particles/model/velocity/value"][4:] = np.nan
    numbers, tables = measured(directory, comm)
    assert not numbers["rollout"]["stable"] and len(tables["model"]["time"]) == 4
    assert numbers["rollout"]["broken"] == pytest.approx(0.4 / 1.2)
    (directory / "ground_truth.h5").unlink()
    numbers, tables = measured(directory, comm)
    assert numbers["not_compared"] == "ground_truth.h5 is not here" and set(tables) == {"model"}
    assert numbers["truth"] is None and numbers["accuracy"]["velocity_kl"] is None


@pytest.mark.mpi(2, timeout=60)
def test_solves_that_do_not_converge_are_logged_once_and_frames_that_cannot_be_read_end_all_ranks(
        comm, directory, monkeypatch, caplog):
    monkeypatch.setattr(particle_measures, "MOST_ITERATIONS", 2)
    with caplog.at_level(logging.INFO, logger="eddies"):
        measure.run(directory, comm)
    said = [message for message in caplog.messages if "did not converge in 2 iterations" in message]
    assert len(said) == (comm.rank == 0)
    comm.Barrier()
    if comm.rank == 0:
        with changed(directory / "ground_truth.h5") as file:
            file["particles/tracers/position/value"][7] = np.nan
    comm.Barrier()
    with pytest.raises(ProductError, match="position/value, frame 7: holds values that are not finite"):
        measure.run(directory, comm)
