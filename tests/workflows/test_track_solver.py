"""The grid on which the modes of measured particles are solved for, and the particles that a solve leaves out."""

from functools import partial

import numpy as np
import pytest

from eddies.parallel.migration import id_block
from eddies.particles.particle_set import ParticleSet
from eddies.scene.sections import Reconstruction, Tracers
from eddies.workflows.track_solver import HELD_OUT, best_solver, slabs_for, solver_of, split


@pytest.mark.mpi(1)
@pytest.mark.parametrize("kolmogorov_length, planes, highest", [(0.0, 28, 12), (0.1, 26, 10), (1.0, 14, 1)])
def test_the_grid_of_a_memory_has_the_planes_that_the_spectrum_of_the_flow_needs(comm, kolmogorov_length, planes,
                                                                                 highest):
    """8^3 particles resolve wavenumbers up to 6, a memory up to 12, and spectra end at 1.05 / eta."""
    tracers = Tracers(particles_per_side=8, turnovers=1.0, frame_interval=0.1)
    resolved = Reconstruction(method="memory").resolving(tracers, filtered=False)
    width = 1e-3 * tracers.spacing
    slab = slabs_for(comm, tracers, resolved, width, kolmogorov_length)
    reference = {"velocity_rms": 1.0, "acceleration_rms": 1.0, "density_mean": 1.0, "viscosity": 0.01,
                 "filter_width": width, "spacing": resolved.spacing, "kolmogorov_length": kolmogorov_length}
    filtered, whole = (solver_of(slab, reference, (1, 1, 1), given, 1.0) for given in (True, False))
    assert (slab.planes, filtered.grid.resolved) == (planes, highest)
    # Solves of filtered tracks must not leave an error that is larger than the small one of the data.
    assert filtered.tolerance == filtered.tolerance_predicted < whole.tolerance == whole.tolerance_predicted


def particles_with(ids):
    """Particles at random places of the cube, in a shear flow."""
    position = 2 * np.pi * np.random.default_rng(1).random((len(ids), 3))
    velocity = np.sin(position[:, [1, 2, 0]])
    return ParticleSet.from_numpy({"id": ids, "position": position, "velocity": velocity})


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("ids", [
    np.arange(4000), 2**32 * np.arange(4000), 2**40 * np.arange(4000), 1000003 * np.arange(4000),
    2**53 - 1 - np.arange(4000), 2**32 * (np.arange(4000) // 1000) + np.arange(4000) % 1000, -np.arange(4000)],
    ids=["numbers", "upper bits", "highest bits", "multiples", "large", "camera and number", "negative"])
def test_the_share_that_is_left_out_is_that_for_ids_of_any_pattern_and_any_ranks(comm, ids):
    start, stop = id_block(comm, len(ids))
    whole, own = particles_with(ids), particles_with(ids[start:stop])
    apart = [split(each, HELD_OUT)[1].id.numpy() for each in (whole, own)]
    np.testing.assert_array_equal(apart[0], np.concatenate(comm.allgather(apart[1])))
    # Five standard deviations of 4000 independent choices.
    assert len(apart[0]) == pytest.approx(HELD_OUT * len(ids), abs=5 * np.sqrt(HELD_OUT * (1 - HELD_OUT) * len(ids)))
    assert len(split(whole, 0.999)[0].id) < 30


@pytest.mark.mpi(1)
def test_ids_in_the_upper_bits_have_an_error_of_validation(comm):
    tracers = Tracers(particles_per_side=8, turnovers=1.0, frame_interval=0.1)
    slab = slabs_for(comm, tracers, tracers, 1e-3 * tracers.spacing, 0.0)
    reference = {"velocity_rms": 0.7, "acceleration_rms": 1.0, "density_mean": 1.0, "viscosity": 0.0,
                 "filter_width": 1e-3 * tracers.spacing, "spacing": tracers.spacing, "kolmogorov_length": 0.0}
    make = partial(solver_of, slab, reference, (1, 1, 1), False)
    _, _, error = best_solver(particles_with(2**32 * np.arange(512)), make)
    assert 0 < error < 0.2
