"""Puts together the trained kernel, the grid and the density closure that needs both."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch

from eddies.flow.pressure import PressureSolver
from eddies.io.weights import load_weights
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.poisson_closure import PoissonClosure
from eddies.particles.smoothing_kernels import HermiteKernel, KernelNetwork, WendlandC2


def load_kernel(comm, path: str | Path, device: torch.device | str = "cpu") -> HermiteKernel:
    """The trained kernel as the table that is used at run time, in single precision."""
    description, tensors = load_weights(comm, path, "kernel")
    network = KernelNetwork(description["support"], description["hidden"], description["cutoff"])
    network = network.to(dtype=torch.float32, device=device)
    network.load_state_dict({name: torch.from_numpy(tensor) for name, tensor in tensors.items()})
    with torch.no_grad():
        return network.table()


def poisson_closure(decomposition: SlabDecomposition, sound_speed: float, dtype: torch.dtype, skin: float = 0.0,
                    drift: float = 0.0) -> PoissonClosure:
    """The Poisson closure on a grid of one cell for each plane of the slabs, and as many particles.

    24 neighbours, four passes and modes up to three quarters of the Nyquist wavenumber are the best of a trial on
    filtered turbulence (64^3 cells, 32^3 particles): error of -grad p at the particles 0.30, against 0.32 of the exact
    filtered pressure gradient and 0.42 of a single pass; more neighbours smooth more and cost more, higher modes carry
    more noise than flow. `drift` is how far particles may move beyond the skin before they change rank.
    """
    neighbors, nyquist = 24, decomposition.planes / 2
    support = decomposition.spacing * (neighbors / (4 / 3 * np.pi)) ** (1 / 3)
    margin = max(math.ceil((skin / 2 + drift) / decomposition.spacing), 1)
    solver = PressureSolver(decomposition, resolved=int(0.75 * nyquist), margin=margin)
    return PoissonClosure(solver, WendlandC2(support), sound_speed, skin=skin, dtype=dtype)
