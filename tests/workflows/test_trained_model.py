import pytest
import torch

from eddies.io.hdf5 import ProductError
from eddies.io.weights import save_weights
from eddies.particles.pair_forces import PairModel
from eddies.particles.reference_scales import ReferenceScales
from eddies.workflows.trained_model import load_model

SCALES = ReferenceScales(length=0.8, spacing=0.4, velocity=0.9, density_mean=1.0, density=0.02, acceleration=1.7,
                         density_rate=0.05, sound_speed=20.0, viscosity=0.01)


def saved(comm, directory, change=lambda weights: weights):
    """A model and the file of its weights, changed."""
    model = PairModel(SCALES, 1.1, 40.0, (4,), closure="poisson-stress", seed=5).float()
    weights = change({name: tensor.numpy() for name, tensor in model.state_dict().items()})
    save_weights(comm, directory / "model.h5", "model", model.state_description(), weights, {})
    return model, directory / "model.h5"


@pytest.mark.mpi(1, 2)
def test_a_model_is_read_as_it_was_saved_in_its_precision(comm, tmp_path):
    model, path = saved(comm, tmp_path)
    found = load_model(comm, path, torch.device("cpu"))
    assert found.state_description() == model.state_description()
    assert all(torch.equal(tensor, found.state_dict()[name]) and tensor.dtype == torch.float32
               for name, tensor in model.state_dict().items())


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("change", [
    lambda weights: {**weights, "force_factors": weights["force_factors"][:3]},
    lambda weights: {("stress_factors" if name == "force_factors" else name): tensor
                     for name, tensor in weights.items()}], ids=["another shape", "another name"])
def test_weights_of_an_older_form_are_refused(comm, tmp_path, change):
    _, path = saved(comm, tmp_path, change)
    with pytest.raises(ProductError, match='model.h5: closure = "poisson-stress" has other weights now .*'
                                           "run `eddies train` again"):
        load_model(comm, path, torch.device("cpu"))
