"""Reading the ground truth, with and without a stored density."""

import h5py
import numpy as np
import pytest
from mpi4py import MPI

from eddies.io.hdf5 import ProductError, open_product
from eddies.io.trajectories import Trajectory
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.particle_field import grid_points
from eddies.workflows.ground_truth.truth import GroundTruth
from tests.commands import first_rank
from tests.changed_product import changed
from tests.workflows.synthetic_run import LENGTH, write_ground_truth

FRAMES = 5


def written(comm, directory, density=True):
    """The path of a synthetic ground truth."""
    first_rank(comm, write_ground_truth, MPI.COMM_SELF, directory, frames=FRAMES, density=density)
    return directory / "ground_truth.h5"


def read(comm, path, ask):
    """The result of `ask`, and the stored times and columns (frames, particles, ...)."""
    with open_product(comm, path, "ground_truth") as file:
        answer = ask(GroundTruth(file, comm))
        stored = Trajectory(file, "tracers")
        columns = {name: np.stack([stored.read(frame, name) for frame in range(FRAMES)]) for name in stored.columns}
        return answer, stored.times, columns


@pytest.mark.mpi(3)
def test_a_field_at_the_points_of_all_ranks_is_the_stored_one(comm, tmp_path):
    """The slabs have one plane less than the grid, so that their faces differ from grid planes."""
    path = written(comm, tmp_path)
    with h5py.File(path) as file:
        stored = file["fields/filtered/velocity"][0].reshape(3, -1).T
    cells = round(len(stored) ** (1 / 3))

    def ask(truth):
        other = GroundTruth(truth._file, comm, planes=cells - 1)
        return other.field_at(0, grid_points(other.decomposition, cells))

    found = np.concatenate(comm.allgather(read(comm, path, ask)[0]))
    assert np.array_equal(found, stored)


@pytest.mark.mpi(2)
@pytest.mark.parametrize("density", [True, False], ids=["density", "no density"])
def test_columns_and_scales_are_those_that_are_stored(comm, tmp_path, density):
    def ask(truth):
        return truth.scales, truth.particles(1), truth.particles_with_rates(1), truth.window(1, 2)

    (scales, particles, rates, window), times, stored = read(comm, written(comm, tmp_path, density), ask)
    assert (scales.velocity, scales.acceleration, scales.viscosity) == (1.0, 1.4, 0.014)  # of the group `reference`
    assert scales.sound_speed == (20.0 if density else None)
    assert (scales.density is None) == (scales.density_rate is None) == (not density)
    names = {"position", "velocity"} | ({"density"} if density else set())
    assert stored.keys() == names | {"image"} and particles.keys() == {"id"} | names
    assert rates.keys() == {"id", "acceleration"} | names | ({"density_rate"} if density else set())
    assert window.keys() == {"id"} | names | {f"{name}_later" for name in names}
    ids = particles["id"]
    assert comm.allreduce(len(ids)) == stored["velocity"].shape[1]
    for name in names:
        assert np.array_equal(particles[name], stored[name][1][ids])
        assert np.array_equal(window[f"{name}_later"], stored[name][2:4, window["id"]].swapaxes(0, 1))
    for name, rate in {"velocity": "acceleration", "density": "density_rate"}.items():
        if name in names:
            change = (stored[name][2] - stored[name][0]) / (times[2] - times[0])
            assert np.allclose(rates[rate], change[ids], rtol=1e-13, atol=0)


@pytest.mark.mpi(2, timeout=30)
def test_a_value_that_is_not_finite_is_refused_by_all_ranks(comm, tmp_path):
    """Only one rank reads the value, the first or the last."""
    path = written(comm, tmp_path)

    def planes(truth):
        return truth.planes(truth.fields, 0, "velocity", SlabDecomposition(comm, LENGTH, truth.fields.cells))

    for dataset, where, ask in (
            ("particles/tracers/velocity/value", (2, -1, 0), lambda truth: truth.particles(2)),
            ("particles/tracers/density/value", (3, 0), lambda truth: truth.particles(3)),
            ("fields/filtered/velocity", (0, 0, -1, 0, 0), planes)):
        if comm.rank == 0:
            with changed(path) as file:
                file[dataset][where] = np.nan
        comm.Barrier()
        with pytest.raises(ProductError, match=f"ground_truth.h5: /{dataset}, frame {where[0]}: .*not finite"):
            with open_product(comm, path, "ground_truth") as file:
                ask(GroundTruth(file, comm))
        comm.Barrier()
