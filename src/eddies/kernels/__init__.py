"""Compiled loops for the processor, called through a plain C interface."""
