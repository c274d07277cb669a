import pytest
import torch

from eddies.io.hdf5 import ProductError
from eddies.io.weights import save_weights
from eddies.particles.smoothing_kernels import KernelNetwork
from eddies.workflows.learned.kernel import load_kernel

NETWORK = KernelNetwork(0.7, [4], seed=3).float()


def write(comm, directory, **description):
    weights = {name: tensor.numpy() for name, tensor in NETWORK.state_dict().items()}
    description = {"support": 0.7, "hidden": [4], "cutoff": "smooth", **description}
    save_weights(comm, directory / "kernel.h5", "kernel", description, weights, {})


@pytest.mark.mpi(1)
def test_the_kernel_is_read_as_it_was_trained(comm, tmp_path):
    write(comm, tmp_path, form=KernelNetwork.FORM)
    distance = torch.linspace(0, 0.8, 50)
    assert torch.equal(load_kernel(comm, tmp_path / "kernel.h5").value(distance), NETWORK.table().value(distance))


@pytest.mark.mpi(1, 2)
def test_weights_of_the_form_that_could_be_negative_are_refused(comm, tmp_path):
    """Files older than the form do not name it."""
    write(comm, tmp_path)
    with pytest.raises(ProductError, match=r'kernel.h5: form = "NN g", .*remove it and run `eddies train-kernel`'):
        load_kernel(comm, tmp_path / "kernel.h5")
