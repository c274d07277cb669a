import pytest
import torch

from eddies.particles.particle_set import ParticleSet


def columns(count=3):
    return {"id": torch.arange(count), "position": torch.rand(count, 3), "velocity": torch.rand(count, 3),
            "density": torch.ones(count)}


@pytest.mark.parametrize("names", [("id", "position", "velocity", "density"), ("id", "position", "velocity")])
def test_particles_survive_the_conversion_to_arrays(names):
    given = {name: columns()[name] for name in names}
    again = ParticleSet.from_numpy({**ParticleSet(**given).to_numpy(), "extra": None})
    assert len(again) == 3 and again.columns().keys() == given.keys()
    assert all(torch.equal(again.columns()[name], column) for name, column in given.items())


@pytest.mark.parametrize("name", ["position", "velocity", "density"])
def test_columns_of_another_length_are_refused(name):
    with pytest.raises(ValueError, match=name):
        ParticleSet(**{**columns(), name: columns(4)[name]})
