"""Slab decomposition, transposes, particle migration, ghost-particle halos and reductions: the messages of eddies."""
