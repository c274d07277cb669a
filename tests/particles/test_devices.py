import pytest
import torch

from eddies.errors import UserError
from eddies.particles.devices import prepare_torch
from eddies.particles.particle_set import ParticleSet
from eddies.scene.terms import PRESETS
from tests.particles.configurations import MODELS, assert_close, distributed, dynamics_of, given, model, state


@pytest.mark.mpi(1)
def test_a_missing_gpu_is_an_error_of_the_user(comm, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UserError, match='device = "cuda"'):
        prepare_torch("cuda", comm)


def rates_and_gradients(slab, particles, terms, device):
    """Rates of the particles, and gradients of a loss by the parameters, on a device."""
    there = ParticleSet(**{name: column.to(device) for name, column in particles.columns().items()})
    force = model(terms).to(device)
    rates = list(given(dynamics_of(slab, force, iterations=8).rates(there)).values())
    parameters, loss = list(force.parameters()), sum(rate.square().sum() for rate in rates)
    return [*rates, *(torch.autograd.grad(loss, parameters) if parameters else ())]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")
@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("terms", [*MODELS.values(), PRESETS["local"]], ids=[*MODELS, "local"])
def test_rates_and_gradients_on_a_gpu_are_those_on_the_processor(comm, terms):
    slab, particles = distributed(comm, *state())
    on_gpu, expected = (rates_and_gradients(slab, particles, terms, device)
                        for device in (prepare_torch("cuda", comm), torch.device("cpu")))
    assert len(on_gpu) == len(expected) > 0
    for one, other in zip(on_gpu, expected):
        assert one.device.type == "cuda"
        assert_close(one.cpu(), other, 1e-9)  # sums are in another order
