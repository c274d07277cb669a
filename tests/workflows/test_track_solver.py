"""The grid on which the modes of measured particles are solved for."""

import pytest

from eddies.scene.sections import Reconstruction, Tracers
from eddies.workflows.track_solver import slabs_for, solver_of


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
    assert (slab.planes, solver_of(slab, reference, 1.0).grid.resolved) == (planes, highest)
