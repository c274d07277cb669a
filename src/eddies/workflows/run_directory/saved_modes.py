"""Fourier modes in checkpoints: each rank writes its part, and reads that part on any number of ranks."""

from __future__ import annotations

import numpy as np

from eddies.io.checkpoint import Block, Checkpoint
from eddies.spectral.spectral_grid import SpectralGrid


def saved_modes(grid: SpectralGrid, modes: np.ndarray) -> Block:
    """Modes (..., kz, ky, kx) of a grid for a checkpoint. Ranks share the axis ky."""
    return Block(modes, int(grid.column_starts[grid.decomposition.rank]), grid.modes, axis=modes.ndim - 2)


def restored_modes(grid: SpectralGrid, saved: Checkpoint, dimensions: int) -> np.ndarray:
    """The part of this rank in the block "modes" of a checkpoint, an array of so many dimensions."""
    start, stop = grid.column_starts[grid.decomposition.rank:][:2]
    return saved.read("modes", int(start), int(stop), axis=dimensions - 2)
