"""Tools around MPI: set-up, launcher, doctor and the pytest plugin. From eddies they import only `cores`."""
