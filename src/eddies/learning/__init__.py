"""Training on particles of all ranks: a loss is that of all particles, and gradients are summed over ranks."""
