"""Messages between ranks: slabs, transposes, migration of particles, halos, reductions and votes."""
