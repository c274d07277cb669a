"""What is read and measured of a rollout and its truth: alike, on any number of ranks, and of the truth once."""

import logging
import os
from pathlib import Path

import h5py
import numpy as np
import pytest

from eddies.analysis.accuracy import accuracy
from eddies.io.hdf5 import ProductError, open_product
from eddies.io.trajectories import Trajectory
from eddies.workflows.rollout import truth_cache
from eddies.workflows.rollout.measured import TrueParticles, open_rollout
from eddies.workflows.rollout.particle_measures import FieldsOfParticles, ParticleSpectra
from tests.changed_product import changed
from tests.workflows.synthetic_run import START, write_kernel, write_rollout, write_run

CACHE = "truth_measures.h5"


@pytest.fixture
def directory(comm, tmp_path):
    """A made-up run."""
    if comm.rank == 0:
        write_run(comm.Create_group(comm.group.Incl([0])), tmp_path)
    comm.Barrier()
    return tmp_path


@pytest.fixture
def work(monkeypatch):
    """Whose frames have been measured, as pairs of name and frame, and how often."""
    done = []

    def counted(method, whose):
        def measure(self, particles, frame, *more):
            done.append((whose(particles), frame))
            return method(self, particles, frame, *more)
        return measure

    for cls, method in ((FieldsOfParticles, "gradients"), (ParticleSpectra, "of")):
        monkeypatch.setattr(cls, method, counted(getattr(cls, method), lambda particles: "truth" if isinstance(
            particles, TrueParticles) else "model"))
    return done


def numbers(directory, comm, whole=True):
    """All that is measured, on one rank, by quantity, name and frame; as bytes."""
    with open_rollout(directory, comm) as measured:
        measured.measure(comm, whole=whole)
        run = measured.rollout
        return told(run)


def told(run):
    found = {("spectra", of, frame): energy.tobytes()
             for of in run.spectra for frame, energy in run.spectra[of].items()}
    for of in run.reconstructions:
        for frame, each in run.reconstructions[of].items():
            found["reconstructions", of, frame] = b"".join(np.asarray(value).tobytes() for value in (
                each.invariants.second, each.invariants.third, each.invariants.scale, each.velocity, each.vorticity))
    return found


@pytest.mark.mpi(1)
def test_the_true_particles_are_those_of_the_ground_truth_at_the_times_of_the_rollout(comm, directory):
    with open_product(comm, directory / "ground_truth.h5", "ground_truth") as file:
        tracers = Trajectory(file, "tracers")
        truth = TrueParticles(tracers, START, np.array([0.0, 0.05, 0.1, 0.5, 0.6, 0.7]))
        # Between frames there is none, and of the last no acceleration is known.
        assert truth.times.tolist() == [0.0, 0.1, 0.5] and truth.frames.tolist() == [6, 7, 11]
        assert set(truth.columns) == {"position", "velocity", "density", "image", "acceleration"}
        for column in ("position", "velocity", "density"):
            assert truth.read(1, column).dtype == np.float32
            assert np.array_equal(truth.read(1, column, 3, 9), tracers.read(7, column)[3:9].astype(np.float32))
        change = (tracers.read(8, "velocity") - tracers.read(6, "velocity")) / (tracers.times[8] - tracers.times[6])
        assert np.array_equal(truth.read(1, "acceleration"), change.astype(np.float32))
        # Paths begin within the box, where the rollout does.
        assert not truth.read(0, "image").any()
        assert np.array_equal(truth.read(2, "image"), tracers.read(11, "image") - tracers.read(6, "image"))


@pytest.mark.mpi(1, 2, 3)
def test_ranks_that_share_the_work_find_what_one_finds(comm, directory):
    alone, root = comm.Split(comm.rank), comm.size - 1
    with open_rollout(directory, alone) as measured:
        measured.measure(comm, root, late=True)
        found = told(measured.rollout) if comm.rank == root else None
    comm.Barrier()
    if comm.rank == root:
        with open_rollout(directory, alone) as lazy:
            run = lazy.rollout
            for quantity, of, frame in found:
                getattr(run, quantity)[of][frame]
            assert told(run) == found
        # Spectra of three frames and the second half of the model; averages of all that there are.
        assert {frame for quantity, of, frame in found if (quantity, of) == ("spectra", "truth")} == {0, 2, 4}
        assert {frame for quantity, of, frame in found if (quantity, of) == ("spectra", "model")} == {0, 2, 4, 6, 7, 8}
        for of, count in (("model", 9), ("truth", 6)):
            assert sum((quantity, whose) == ("reconstructions", of) for quantity, whose, _ in found) == count
    comm.Barrier()


@pytest.mark.mpi(1)
def test_what_measures_of_accuracy_need_is_no_more_than_the_last_frame(comm, directory, work):
    with open_rollout(directory, comm) as measured:
        measured.measure(comm, whole=False)
        assert sorted(set(work)) == [("model", 5), ("truth", 5)]
        before = list(work)
        found = accuracy(measured.rollout)
        assert work == before and found["qr_kl"] > 0 and found["velocity_error_end"] > 0
        # The flow is known at every other frame, and not at this one.
        assert found["spectrum_error"] is None


@pytest.mark.mpi(1)
def test_the_truth_is_measured_once_for_all_variants(comm, directory, work, tmp_path):
    """They are in directories of their own, in which the ground truth and the kernel are links."""
    first = numbers(directory, comm)
    work.clear()
    assert numbers(directory, comm) == first and {of for of, _ in work} == {"model"}
    variant = tmp_path / "variant"
    variant.mkdir()
    for product in ("ground_truth.h5", "kernel.h5"):
        (variant / product).symlink_to(Path("..") / product)
    write_rollout(comm, variant, frames=5, status="stopped: here")
    work.clear()
    found = numbers(variant, comm)
    # Of its last frame no spectrum has been shown before.
    assert {frame for of, frame in work if of == "truth"} <= {3} and not (variant / CACHE).exists()
    common = [key for key in found if key[1] == "truth" and key in first]
    assert len(common) > 5 and all(found[key] == first[key] for key in common)
    work.clear()
    assert numbers(variant, comm) == found and numbers(directory, comm) == first
    assert {of for of, _ in work} == {"model"}


def damage(path):
    """Flip a bit in the largest array, which HDF5 does not notice."""
    with h5py.File(path) as file:
        values = file["reconstructions_of_truth/second"].id
        offset, size = values.get_offset(), values.get_storage_size()
    content = bytearray(path.read_bytes())
    content[offset + size // 2] ^= 1
    path.write_bytes(content)


HARMS = {
    "a flipped bit": damage,
    "cut off": lambda path: os.truncate(path, path.stat().st_size // 2),
    "no HDF5": lambda path: path.write_text("no HDF5"),
    "of another ground truth": lambda path: os.utime(path.with_name("ground_truth.h5"), ns=(1, 1)),
    "of another kernel": lambda path: os.utime(path.with_name("kernel.h5"), ns=(1, 1)),
}


@pytest.mark.mpi(1)
@pytest.mark.parametrize("harm", HARMS)
def test_a_cache_that_is_damaged_or_stale_is_not_trusted(comm, directory, work, harm):
    first = numbers(directory, comm)
    HARMS[harm](directory / CACHE)
    work.clear()
    assert numbers(directory, comm) == first and {of for of, _ in work} == {"model", "truth"}
    work.clear()  # it has been made anew
    assert numbers(directory, comm) == first and {of for of, _ in work} == {"model"}


@pytest.mark.mpi(1)
def test_another_kernel_measures_anew(comm, directory):
    first = numbers(directory, comm)
    write_kernel(comm, directory, seed=2)
    second = numbers(directory, comm)
    assert all((first[key] == second[key]) == (key[0] == "spectra") for key in first)


@pytest.mark.mpi(1)
def test_other_code_measures_anew(comm, directory, work, monkeypatch):
    numbers(directory, comm)
    monkeypatch.setattr(truth_cache, "_code", lambda: "of other sources")
    work.clear()
    numbers(directory, comm)
    assert {of for of, _ in work} == {"model", "truth"}


@pytest.mark.mpi(1)
def test_a_cache_that_cannot_be_written_costs_no_more_than_itself(comm, directory, work):
    """A directory stands in its place."""
    (directory / CACHE).mkdir()
    (directory / CACHE / "precious").write_text("x")
    first = numbers(directory, comm)
    work.clear()
    assert numbers(directory, comm) == first and {of for of, _ in work} == {"model", "truth"}
    assert [path.name for path in directory.glob("*.partial")] == [] and (directory / CACHE / "precious").exists()


@pytest.mark.mpi(1)
def test_without_ground_truth_or_kernel_there_is_what_is_left(comm, directory):
    with open_rollout(directory, comm) as measured:
        assert set(measured.groups) == {"particles/truth", *(f"{what}{of}" for of in ("model", "truth") for what in (
            "spectra_of_", "fields/", "gradients/"))}
        assert measured.exported["particles"]["model"].read(0, "velocity_gradient").shape == (600, 3, 3)
    (directory / "kernel.h5").unlink()
    with open_rollout(directory, comm) as measured:
        measured.measure(comm)
        assert measured.rollout.reconstructions is None and measured.exported["fields"] == {}
        assert set(measured.groups) == {"particles/truth", "spectra_of_model", "spectra_of_truth"}
        assert accuracy(measured.rollout)["qr_kl"] is None
    (directory / "ground_truth.h5").unlink()
    with open_rollout(directory, comm) as measured:
        measured.measure(comm)
        assert measured.groups == {} and list(measured.exported["particles"]) == ["model"]
        with pytest.raises(ValueError, match="ground_truth.h5 is not here"):
            measured.rollout.common


@pytest.mark.mpi(2, timeout=60)
def test_a_frame_that_one_rank_cannot_read_is_told_by_all(comm, directory):
    if comm.rank == 0:
        with changed(directory / "ground_truth.h5") as file:
            file["particles/tracers/position/value"][7] = np.nan
    comm.Barrier()
    with open_rollout(directory, comm.Split(comm.rank)) as measured, pytest.raises(
            ProductError, match="position/value, frame 7: holds values that are not finite"):
        measured.measure(comm)


@pytest.mark.mpi(2)
def test_solves_that_do_not_converge_are_told_once(comm, directory, monkeypatch, caplog):
    from eddies.workflows.rollout import particle_measures
    monkeypatch.setattr(particle_measures, "MOST_ITERATIONS", 2)
    with caplog.at_level(logging.INFO, logger="eddies"), open_rollout(directory, comm.Split(comm.rank)) as measured:
        measured.measure(comm)
    said = [message for message in caplog.messages if "did not converge in 2 iterations" in message]
    assert len(said) == (comm.rank == 0)
    assert not said or said[0].endswith(", as may others")
