"""Puts together the trained kernel, the grid and the density closure that needs both."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from eddies.flow.pressure import PressureSolver
from eddies.io.hdf5 import ProductError
from eddies.io.weights import load_weights
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.pair_forces import PairModel
from eddies.particles.poisson_closure import PoissonClosure
from eddies.particles.smoothing_kernels import HermiteKernel, KernelNetwork, WendlandC2


def load_kernel(comm, path: str | Path, device: torch.device | str = "cpu") -> HermiteKernel:
    """The trained kernel as the table that is used at run time, in single precision.

    ProductError, besides the reasons of `load_weights`, where the weights are those of another form of the kernel.
    """
    description, tensors = load_weights(comm, path, "kernel")
    form = description.get("form", "NN g")
    if form != KernelNetwork.FORM:
        raise ProductError(f'{path}: form = "{form}", which may be negative; the kernel is now "{KernelNetwork.FORM}": '
                           "run `eddies train-kernel` again")
    network = KernelNetwork(description["support"], description["hidden"], description["cutoff"])
    network = network.to(dtype=torch.float32, device=device)
    network.load_state_dict({name: torch.from_numpy(tensor) for name, tensor in tensors.items()})
    with torch.no_grad():
        return network.table()


def density_closure(model: PairModel, decomposition: SlabDecomposition, dtype: torch.dtype, skin: float = 0.0,
                    drift: float = 0.0) -> PoissonClosure | None:
    """The closure of a model's density, with the force that it may have; None for a model that learns the density."""
    if model.learns_density:
        return None
    factors = None if model.closure == "poisson" else model.resolved_factors
    return poisson_closure(decomposition, model.scales.sound_speed, dtype, skin, drift, factors)


def poisson_closure(decomposition: SlabDecomposition, sound_speed: float, dtype: torch.dtype, skin: float = 0.0,
                    drift: float = 0.0, factors: Callable[[], Tensor] | None = None) -> PoissonClosure:
    """The Poisson closure on a grid of one cell for each plane of the slabs, and as many particles.

    16 neighbours, four passes and modes up to seven eighths of the Nyquist wavenumber are the best of a trial on
    filtered turbulence (32^3 particles): error of -grad p at the particles 0.366 in `hit` and 0.343 in `hit-small`,
    against 0.415 and 0.365 of the exact filtered pressure gradient, and 0.377 and 0.350 with two passes. More passes
    gain less than 0.002; more neighbours smooth more and cost more. `drift` is how far particles may move beyond the
    skin before they change rank.
    """
    neighbors, nyquist = 16, decomposition.planes / 2
    support = decomposition.spacing * (neighbors / (4 / 3 * np.pi)) ** (1 / 3)
    margin = max(math.ceil((skin / 2 + drift) / decomposition.spacing), 1)
    solver = PressureSolver(decomposition, resolved=int(7 / 8 * nyquist), margin=margin)
    return PoissonClosure(solver, WendlandC2(support), sound_speed, skin=skin, dtype=dtype, factors=factors)
