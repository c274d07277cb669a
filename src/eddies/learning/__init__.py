"""Training on particles shared among ranks: losses that are global, gradients that are summed."""
