"""The trained smoothing kernel of a file."""

from __future__ import annotations

from pathlib import Path

import torch

from eddies.io.hdf5 import ProductError
from eddies.io.weights import load_weights
from eddies.parallel.communicator import Comm
from eddies.particles.smoothing_kernels import HermiteKernel, KernelNetwork


def load_kernel(comm: Comm, path: str | Path, device: torch.device | str = "cpu") -> HermiteKernel:
    """The trained kernel as the table that is used at run time, in single precision.

    ProductError, besides the reasons of `load_weights`, where the weights are those of another form of the kernel.
    """
    description, tensors = load_weights(comm, path, "kernel")
    form = description.get("form", "NN g")
    if form != KernelNetwork.FORM:
        raise ProductError(f'{path}: form = "{form}", which may be negative; the kernel is now "{KernelNetwork.FORM}": '
                           "remove it and run `eddies train-kernel` again")
    network = KernelNetwork(description["support"], description["hidden"], description["cutoff"])
    network = network.to(dtype=torch.float32, device=device)
    network.load_state_dict({name: torch.from_numpy(tensor) for name, tensor in tensors.items()})
    with torch.no_grad():
        return network.table()
