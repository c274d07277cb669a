"""Measures of a rollout and its truth: the same on any number of ranks, and made once."""

import logging
from pathlib import Path

import numpy as np
import pytest

from eddies.analysis.against_truth import accuracy
from eddies.io.hdf5 import ProductError, open_product
from eddies.io.trajectories import Trajectory
from eddies.workflows.rollout import particle_measures
from eddies.workflows.rollout.measured import TrueParticles, open_rollout
from tests.changed_product import changed
from tests.workflows.counting import count_measures
from tests.workflows.synthetic_run import START, write_kernel, write_rollout, write_run


@pytest.fixture
def directory(comm, tmp_path):
    """A synthetic run, forced and with a stationary state."""
    if comm.rank == 0:
        write_run(comm.Create_group(comm.group.Incl([0])), tmp_path, {"stationary": True}, injection_rate=0.5)
    comm.Barrier()
    return tmp_path


@pytest.fixture
def work(monkeypatch):
    """A list of all measures that are made, as pairs of "model" or "truth" and frame."""
    done = []

    def noted(quantity, particles, frame):
        done.append(("truth" if isinstance(particles, TrueParticles) else "model", frame))

    count_measures(monkeypatch, noted)
    return done


def values_of(run):
    """All measures that a rollout holds, as bytes, by quantity, name and frame."""
    found = {("spectra", of, frame): energy.tobytes()
             for of in run.spectra for frame, energy in run.spectra[of].items()}
    for quantity in ("invariants", "planes"):
        for of, by_frame in getattr(run, quantity).items():
            for frame, each in by_frame.items():
                found[quantity, of, frame] = b"".join(np.asarray(value).tobytes() for value in vars(each).values())
    return found


@pytest.mark.mpi(1)
def test_the_true_particles_are_those_of_the_ground_truth_at_the_times_of_the_rollout(comm, directory):
    with open_product(comm, directory / "ground_truth.h5", "ground_truth") as file:
        tracers = Trajectory(file, "tracers")
        truth = TrueParticles(tracers, START, np.array([0.0, 0.05, 0.1, 0.5, 0.6, 0.7]))
        # There is no frame at t = 0.05, and the last frame has no centred difference.
        assert truth.times.tolist() == [0.0, 0.1, 0.5] and truth.frames.tolist() == [6, 7, 11]
        assert set(truth.columns) == {"position", "velocity", "density", "image", "acceleration"}
        for column in ("position", "velocity", "density"):
            assert truth.read(1, column).dtype == np.float32
            assert np.array_equal(truth.read(1, column, 3, 9), tracers.read(7, column)[3:9].astype(np.float32))
        change = (tracers.read(8, "velocity") - tracers.read(6, "velocity")) / (tracers.times[8] - tracers.times[6])
        assert np.array_equal(truth.read(1, "acceleration"), change.astype(np.float32))
        # Paths begin within the box, at the start of the rollout.
        assert not truth.read(0, "image").any()
        assert np.array_equal(truth.read(2, "image"), tracers.read(11, "image") - tracers.read(6, "image"))


@pytest.mark.mpi(1, 3)
def test_ranks_that_share_the_work_find_what_one_finds(comm, directory):
    alone, root = comm.Split(comm.rank), comm.size - 1
    with open_rollout(directory, alone) as measured:
        measured.measure(comm, root)
        found = values_of(measured.rollout)
        assert bool(found) == (comm.rank == root), "the other ranks keep nothing"
        measured.forget()
        assert not values_of(measured.rollout)
    comm.Barrier()
    if comm.rank == root:
        with open_rollout(directory, alone) as lazy:
            run = lazy.rollout
            for quantity, of, frame in found:
                getattr(run, quantity)[of][frame]
            assert values_of(run) == found
        # Spectra of three frames and of the second half of the model; gradients of all frames; four planes.
        assert {frame for quantity, of, frame in found if (quantity, of) == ("spectra", "truth")} == {0, 2, 4}
        assert {frame for quantity, of, frame in found if (quantity, of) == ("spectra", "model")} == {0, 2, 4, 6, 7, 8}
        for of, count in (("model", 9), ("truth", 6)):
            assert sum((quantity, whose) == ("invariants", of) for quantity, whose, _ in found) == count
            assert sum((quantity, whose) == ("planes", of) for quantity, whose, _ in found) == 4
    comm.Barrier()


@pytest.mark.mpi(1)
def test_accuracy_needs_no_more_than_the_last_frame(comm, directory, work):
    with open_rollout(directory, comm) as measured:
        measured.measure(comm, page=False, every_frame=False)
        assert sorted(set(work)) == [("model", 5), ("truth", 5)]
        before = list(work)
        found = accuracy(measured.rollout)
        assert work == before and found["qr_kl"] > 0 and found["velocity_error_end"] > 0
        # The flow's spectrum is stored for every other frame, and not for this one.
        assert found["spectrum_error"] is None


@pytest.mark.mpi(2)
def test_a_truth_is_measured_once_for_several_rollouts(comm, directory, work):
    """The second rollout is shorter, in a directory with links to the ground truth and the kernel."""
    alone, root, variant = comm.Split(comm.rank), comm.size - 1, directory / "variant"
    if comm.rank == 0:
        variant.mkdir()
        for product in ("ground_truth.h5", "kernel.h5"):
            (variant / product).symlink_to(Path("..") / product)
        write_rollout(alone, variant, frames=5, status="stopped: here")
    comm.Barrier()
    known, found = {}, []
    for number, where in enumerate((directory, variant, directory)):
        work.clear()
        with open_rollout(where, alone) as measured:
            measured.measure(comm, (number + root) % comm.size, known=known)
            found.append(comm.bcast(values_of(measured.rollout), (number + root) % comm.size))
        if number:
            # Only the spectrum of the last frame of the shorter rollout is new.
            assert {frame for of, frame in work if of == "truth"} <= ({3} if number == 1 else set())
    assert found[2] == found[0]
    common = [key for key in found[1] if key[1] == "truth" and key in found[0]]
    assert len(common) > 5 and all(found[1][key] == found[0][key] for key in common)
    assert {key[1] for key in found[1]} == {"model", "truth"}
    # Another kernel reconstructs other fields, and finds the same spectra.
    if comm.rank == 0:
        (variant / "kernel.h5").unlink()
        write_kernel(alone, variant, seed=2)
    comm.Barrier()
    with open_rollout(variant, alone) as measured:
        measured.measure(comm, 0, known=known)
        changed_kernel = comm.bcast(values_of(measured.rollout))
    assert all((found[1][key] == changed_kernel[key]) == (key[0] == "spectra") for key in found[1])


@pytest.mark.mpi(1)
def test_without_ground_truth_or_kernel_there_are_fewer_measures(comm, directory):
    with open_rollout(directory, comm) as measured:
        assert set(measured.groups) == {"particles/truth", *(f"{what}{of}" for of in ("model", "truth") for what in (
            "spectra_of_", "fields/", "gradients/"))}
        assert measured.exported["particles"]["model"].read(0, "velocity_gradient").shape == (600, 3, 3)
    (directory / "kernel.h5").unlink()
    with open_rollout(directory, comm) as measured:
        measured.measure(comm)
        assert measured.rollout.invariants is None and measured.exported["fields"] == {}
        assert set(measured.groups) == {"particles/truth", "spectra_of_model", "spectra_of_truth"}
        assert accuracy(measured.rollout)["qr_kl"] is None
    (directory / "ground_truth.h5").unlink()
    with open_rollout(directory, comm) as measured:
        measured.measure(comm)
        assert measured.groups == {} and list(measured.exported["particles"]) == ["model"]
        with pytest.raises(ValueError, match="ground_truth.h5 is not here"):
            measured.rollout.common


@pytest.mark.mpi(2, timeout=60)
def test_solves_that_do_not_converge_are_logged_once_and_frames_that_cannot_be_read_end_all_ranks(
        comm, directory, monkeypatch, caplog):
    monkeypatch.setattr(particle_measures, "MOST_ITERATIONS", 2)
    with caplog.at_level(logging.INFO, logger="eddies"), open_rollout(directory, comm.Split(comm.rank)) as measured:
        measured.measure(comm)
    said = [message for message in caplog.messages if "did not converge in 2 iterations" in message]
    assert len(said) == (comm.rank == 0)
    comm.Barrier()
    if comm.rank == 0:
        with changed(directory / "ground_truth.h5") as file:
            file["particles/tracers/position/value"][7] = np.nan
    comm.Barrier()
    with open_rollout(directory, comm.Split(comm.rank)) as measured, pytest.raises(
            ProductError, match="position/value, frame 7: holds values that are not finite"):
        measured.measure(comm)
