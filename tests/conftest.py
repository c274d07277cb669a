"""Loads the MPI plugin: mark a test with `@pytest.mark.mpi(1, 2)` and ask for the fixture `comm`."""

pytest_plugins = ["mpi_tools.pytest_mpi"]
