"""HDF5 files: products of the stages, trajectories, fields and weights. The only home of h5py."""
