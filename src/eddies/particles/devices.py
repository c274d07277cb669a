"""The device and the number of threads of torch."""

import torch

from eddies.cores import threads
from eddies.errors import UserError
from eddies.parallel.communicator import Comm, node_rank


def prepare_torch(device: str, comm: Comm) -> torch.device:
    """Return the device of this rank, and set the number of threads to OMP_NUM_THREADS (default 1 per rank).

    The GPUs of a node are assigned to its ranks in turn. Raises UserError if a GPU is requested and there is none.
    """
    torch.set_num_threads(threads())
    if device == "cpu":
        return torch.device("cpu")
    if not torch.cuda.is_available():
        raise UserError('device = "cuda": torch finds no GPU here; set device = "cpu"')
    return torch.device("cuda", node_rank(comm) % torch.cuda.device_count())


def kernels_serve(device: torch.device) -> bool:
    """Whether the compiled library computes pairs on this device. On other devices torch computes them."""
    return device.type == "cpu"
