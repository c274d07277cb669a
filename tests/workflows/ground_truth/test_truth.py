"""Reading the ground truth, with and without a stored density."""

import h5py
import numpy as np
import pytest

from eddies.io.hdf5 import ProductError, open_product
from eddies.io.trajectories import Trajectory
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.particle_field import grid_points
from eddies.workflows.ground_truth.truth import GroundTruth
from tests.changed_product import changed
from tests.workflows.synthetic_run import LENGTH, write_ground_truth

FRAMES = 5
every_fluid = pytest.mark.parametrize("density", [True, False], ids=["density", "no density"])


@pytest.fixture
def path(comm, tmp_path, density):
    if comm.rank == 0:
        write_ground_truth(comm.Create_group(comm.group.Incl([0])), tmp_path, frames=FRAMES, density=density)
    comm.Barrier()
    return tmp_path / "ground_truth.h5"


def read(comm, path, ask):
    """The result of `ask`, and the stored times and columns (frames, particles, ...)."""
    with open_product(comm, path, "ground_truth") as file:
        answer = ask(GroundTruth(file, SlabDecomposition(comm, LENGTH, 16)))
        stored = Trajectory(file, "tracers")
        columns = {name: np.stack([stored.read(frame, name) for frame in range(FRAMES)]) for name in stored.columns}
        return answer, stored.times, columns


@pytest.mark.parametrize("density", [True])
@pytest.mark.mpi(3)
def test_a_field_at_the_points_of_all_ranks_is_the_stored_one(comm, path, density):
    """The slabs have one plane less than the grid, so that their faces differ from grid planes."""
    with h5py.File(path) as file:
        stored = file["fields/filtered/velocity"][0].reshape(3, -1).T
    cells = round(len(stored) ** (1 / 3))

    def ask(truth):
        slab = SlabDecomposition(comm, LENGTH, cells - 1)
        return GroundTruth(truth._file, slab).field_at(0, grid_points(slab, cells))

    found = np.concatenate(comm.allgather(read(comm, path, ask)[0]))
    assert np.array_equal(found, stored)


@every_fluid
@pytest.mark.mpi(2)
def test_columns_and_scales_are_those_that_are_stored(comm, path, density):
    def ask(truth):
        return truth.scales, truth.particles(1), truth.particles_with_rates(1), truth.window(1, 2)

    (scales, particles, rates, window), times, stored = read(comm, path, ask)
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
        assert np.array_equal(window[f"{name}_later"], np.stack([stored[name][2][ids], stored[name][3][ids]], axis=1))
    for name, rate in {"velocity": "acceleration", "density": "density_rate"}.items():
        if name in names:
            change = (stored[name][2] - stored[name][0]) / (times[2] - times[0])
            assert np.allclose(rates[rate], change[ids], rtol=1e-13, atol=0)


@pytest.mark.parametrize("density", [True])
@pytest.mark.parametrize("dataset, where, ask", [
    ("particles/tracers/velocity/value", (2, -1, 0), lambda truth: truth.particles(2)),
    ("particles/tracers/density/value", (3, 0), lambda truth: truth.particles(3)),
    ("fields/filtered/velocity", (0, 0, -1, 0, 0),
     lambda truth: truth.planes(truth.fields, 0, "velocity", SlabDecomposition(
         truth.decomposition.comm, LENGTH, truth.fields.cells))),
])
@pytest.mark.mpi(2, timeout=30)
def test_a_value_that_is_not_finite_is_refused_by_all_ranks(comm, path, density, dataset, where, ask):
    """Only one rank reads the value, the first or the last."""
    if comm.rank == 0:
        with changed(path) as file:
            file[dataset][where] = np.nan
    comm.Barrier()
    with pytest.raises(ProductError, match=f"ground_truth.h5: /{dataset}, frame {where[0]}: .*not finite"):
        read(comm, path, ask)


@pytest.mark.parametrize("density", [True])
@pytest.mark.mpi(2, timeout=30)
def test_changed_bytes_are_an_error_on_all_ranks(comm, path, density):
    """The bytes are those of the last particle, which only the last rank reads."""
    if comm.rank == 0:
        with h5py.File(path) as file:
            frame = file["particles/tracers/velocity/value"].id.get_chunk_info_by_coord((2, 0, 0))
        with open(path, "r+b") as file:
            file.seek(frame.byte_offset + frame.size - 8)
            file.write(np.float64(0.5).tobytes())
    comm.Barrier()
    with pytest.raises(ProductError, match="ground_truth.h5: particles/tracers/velocity/value, frame 2"):
        read(comm, path, lambda truth: truth.particles(2))
