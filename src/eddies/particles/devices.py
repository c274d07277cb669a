"""Where torch computes, and with how many threads."""

from __future__ import annotations

import torch

from eddies.errors import UserError
from eddies.cores import threads
from eddies.parallel.communicator import Comm, node_rank


class DeviceError(UserError, RuntimeError):
    """There is no such device here."""


def prepare_torch(device: str, comm: Comm) -> torch.device:
    """The device of this rank; sets the number of threads to OMP_NUM_THREADS (default 1 a rank).

    Ranks share the GPUs of a node in turn. Raises DeviceError where a GPU is asked for and there is none.
    """
    torch.set_num_threads(threads())
    if device == "cpu":
        return torch.device("cpu")
    if not torch.cuda.is_available():
        raise DeviceError('device = "cuda": torch finds no GPU here; set device = "cpu"')
    return torch.device("cuda", node_rank(comm) % torch.cuda.device_count())


def kernels_serve(device: torch.device) -> bool:
    """Whether the compiled library takes tensors on a device; on others torch's expressions do the same."""
    return device.type == "cpu"
