"""HDF5 files: products of the stages, trajectories, fields and weights. Only this package imports h5py."""
