"""Training on particles shared among ranks: losses are global, gradients are summed over ranks."""
