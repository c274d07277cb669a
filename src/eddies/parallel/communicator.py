"""The type of the communicator that everything below the command line is given."""

from mpi4py.MPI import Comm

__all__ = ["Comm"]
