"""Tests a priori: errors that need several frames."""

from types import SimpleNamespace

import pytest
from mpi4py import MPI

from eddies.workflows.ground_truth.truth import open_truth
from eddies.workflows.learned.a_priori import _given_rate_error
from tests.workflows.synthetic_run import write_ground_truth


@pytest.mark.mpi(2)
def test_a_density_equal_to_the_true_one_changes_at_the_true_rate(comm, tmp_path):
    if comm.rank == 0:
        write_ground_truth(MPI.COMM_SELF, tmp_path, frames=5)
    comm.Barrier()
    exact = SimpleNamespace(model=SimpleNamespace(integrates_density=True),
                            rates=lambda particles: SimpleNamespace(density=particles.density))
    with open_truth(comm, tmp_path / "ground_truth.h5") as truth:
        assert _given_rate_error(truth, exact, 2) < 1e-12
