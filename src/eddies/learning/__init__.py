"""Training on particles distributed over ranks: losses are global, gradients are summed over ranks."""
