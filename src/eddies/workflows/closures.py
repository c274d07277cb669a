"""Puts together the trained kernel, the grid and the density closure that needs both."""

from __future__ import annotations

from pathlib import Path

import torch

from eddies.flow.pressure import PressureSolver
from eddies.io.weights import load_weights
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.poisson_closure import PoissonClosure
from eddies.particles.smoothing_kernels import HermiteKernel, KernelNetwork


def load_kernel(comm, path: str | Path, device: torch.device | str = "cpu") -> HermiteKernel:
    """The trained kernel as the table that is used at run time, in single precision."""
    description, tensors = load_weights(comm, path, "kernel")
    network = KernelNetwork(description["support"], description["hidden"], description["cutoff"])
    network = network.to(dtype=torch.float32, device=device)
    network.load_state_dict({name: torch.from_numpy(tensor) for name, tensor in tensors.items()})
    with torch.no_grad():
        return network.table()


def poisson_closure(decomposition: SlabDecomposition, kernel: HermiteKernel, sound_speed: float,
                    skin: float = 0.0) -> PoissonClosure:
    """The Poisson closure on a grid with one cell for each plane of the slabs."""
    return PoissonClosure(PressureSolver(decomposition), kernel, sound_speed, skin=skin)
