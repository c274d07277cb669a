"""Tools around MPI: set-up, launcher, doctor and the pytest plugin. Of eddies they import only `cores`."""
