import pytest
import torch

from eddies.particles.particle_set import ParticleSet


def columns(count=3):
    return {
        "id": torch.arange(count),
        "position": torch.rand(count, 3),
        "velocity": torch.rand(count, 3),
        "density": torch.ones(count),
    }


def test_particles_survive_the_way_through_arrays():
    particles = ParticleSet(**columns())
    again = ParticleSet.from_numpy({**particles.to_numpy(), "extra": None})
    assert all(torch.equal(getattr(particles, name), getattr(again, name)) for name in columns())
    assert len(again) == 3


@pytest.mark.parametrize("name", ["position", "velocity", "density"])
def test_columns_of_another_length_are_refused(name):
    with pytest.raises(ValueError, match=name):
        ParticleSet(**{**columns(), name: columns(4)[name]})


def test_without_a_density_there_is_no_such_column():
    given = {name: column for name, column in columns().items() if name != "density"}
    particles = ParticleSet.from_numpy(ParticleSet(**given).to_numpy())
    assert particles.density is None
    assert set(particles.columns()) == set(particles.to_numpy()) == set(given)
