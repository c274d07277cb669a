"""Measures of a rollout: the same on any number of ranks, and made again when the rollout changes."""

import logging
from pathlib import Path

import h5py
import numpy as np
import pytest
from mpi4py import MPI

from eddies.io.hdf5 import ProductError, open_product
from eddies.stored_run import open_run
from eddies.workflows import measure
from eddies.workflows.measure import AXES
from eddies.workflows.rollout import particle_measures
from eddies.workflows.rollout.measured import open_rollout
from eddies.workflows.train_kernel import keep_form
from tests.changed_product import changed
from tests.workflows.synthetic_run import write_kernel, write_rollout, write_run

pytestmark = pytest.mark.usefixtures("quick_spectra")


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


@pytest.mark.mpi(3)
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
    # Three times of figures, start, Kolmogorov time and end, and all common frames of the errors.
    assert [len(tables[name]["time"]) for name in ("velocity_pdfs", "spectra", "planes", "errors", "model")] == [
        3, 3, 3, 6, 9]
    for column in ("velocity", "acceleration"):
        assert tables[f"{column}_pdfs"]["model"].sum(axis=1) == pytest.approx(1)
        assert tables["errors"][f"{column}_kl"][-1] == rollout[f"{column}_kl"]
    assert tables["planes"]["u_x_truth"].dtype == np.float32
    cells = [np.ptp(tables["invariants"][name]) / (tables["invariants"][name].size - 1) for name in ("second", "third")]
    assert [tables["invariants"][of].sum() * np.prod(cells) for of in ("model", "truth")] == pytest.approx([1, 1])
    assert np.isfinite(tables["invariant_rates"]["second_rate_model"]).any()
    assert tables.keys() - AXES.keys() == {"model", "truth", "errors"} and AXES.keys() <= tables.keys()


@pytest.mark.mpi(1)
def test_measures_are_read_with_axes_and_units(comm, directory):
    measure.run(directory, comm)
    run = open_run(directory)
    assert "measures" in run.products
    for group, column, axes, units in (
            ("errors", "velocity_error", ("time",), None), ("velocity_pdfs", "model", ("time", "bin"), None),
            ("model", "energy", ("time",), "L^2/T^2"), ("spectra", "energy_model", ("time", "wavenumber"), "L^2/T^2"),
            ("planes", "u_x_truth", ("time", "y", "x"), "L/T"), ("invariants", "truth", ("second", "third"), None),
            ("increments_model", "structure", ("lag",), "L^2/T^2"), ("paths_truth", "pair_dispersion", ("time",), None),
            ("paths_truth", "tetrad_shape", ("time", "eigenvalue"), None)):
        array = run[f"measures/{group}"][column]
        assert array.dims == axes and array.attrs.get("units") == units, (group, column)
    assert run["measures/planes"]["time"].attrs["units"] == "T" and run["measures/planes"].sizes["time"] == 3


@pytest.mark.mpi(1)
def test_numbers_of_a_known_rollout(comm, tmp_path):
    """The model is the truth plus an error of 0.4 t times an independent flow of the same energy."""
    write_run(comm, tmp_path, total=3000)
    rollout = measured(tmp_path, comm)[0]["rollout"]
    assert rollout["stable"] is True
    assert rollout["last_common_time"] == pytest.approx(0.5 / 1.2)
    assert rollout["velocity_error"] == pytest.approx(0.2, rel=0.15)
    assert rollout["energy_ratio"] == pytest.approx(1.04, abs=0.05)
    # The truth ends before half a turnover. Without any force its particles would keep their first velocities.
    assert rollout["early_time"] == rollout["last_common_time"]
    assert rollout["early_velocity_error"] == rollout["velocity_error"]
    with h5py.File(tmp_path / "ground_truth.h5") as file:
        velocity = file["particles/tracers/velocity/value"][6:12]
        apart, energy = ((velocity[0] - velocity[-1]) ** 2).mean(), velocity.astype(float).var(axis=1).mean(axis=1)
    assert rollout["early_velocity_error_no_force"] == pytest.approx((apart / energy[-1]) ** 0.5, rel=1e-5)
    assert rollout["energy_ratio_no_force"] == pytest.approx(energy[0] / energy[-1], rel=1e-5)
    assert rollout["filter_wavenumber"] == pytest.approx(4)
    assert set(rollout["band_energy_ratios"]) == set(rollout["band_energy_ratios_floor"]) == {"1-2", "3-4"}
    assert rollout["outside_training"] == pytest.approx(0.2e-3)  # at t = 0.4 or 0.5
    assert (rollout["closure_iterations"], rollout["closure_most_iterations"]) == (2.5, 40)
    assert 0 < rollout["velocity_kl"] < 0.1 and 0 < rollout["qr_kl"] < 0.5
    # Both start at the same random points.
    assert 0 < rollout["nearest_distance_kl"] < 0.1
    # Random points in 64 cells.
    assert all(value == pytest.approx(1, abs=0.5) for value in rollout["count_variance"].values())
    # The model's error is a sum of random modes, with a mean over 600 particles. The truth has a sampling error only.
    assert 0 < rollout["momentum_drift"]["truth"] < rollout["momentum_drift"]["model"] < 0.2
    assert all(abs(value) < 1e-2 for value in rollout["density_drift"].values())


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
                   lambda: write_kernel(comm, directory, seed=2),
                   lambda: keep_form(comm, directory / "kernel.h5", "kriging", {}),  # the file keeps its id
                   (directory / "kernel.h5").unlink):
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
        file["particles/model/position/value"][4:, 0] = np.nan
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


@pytest.mark.mpi(2, timeout=60)
def test_a_product_that_one_rank_cannot_open_ends_all_ranks(comm, directory, monkeypatch):
    if comm.rank == 1:
        monkeypatch.setattr(measure, "open_rollout", lambda where, alone: open_rollout(where / "hidden", alone))
    with pytest.raises(ProductError, match="hidden/rollout.h5: no such file"):
        measure.run(directory, comm)
