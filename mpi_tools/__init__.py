"""Tools around MPI: set-up, launcher, doctor and the pytest plugin. None of them imports eddies."""
