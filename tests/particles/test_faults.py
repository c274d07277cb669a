import dataclasses

import pytest
import torch

from eddies.particles.faults import Limits, find_fault, find_unplaced
from eddies.particles.particle_set import ParticleSet
from eddies.particles.periodic_box import PeriodicBox
from tests.particles.configurations import LENGTH, state

LIMITS = Limits(speed=20.0, density_mean=1.0, density_deviation=0.5)


def sound(count=6):
    position, velocity, density = state(count)
    return ParticleSet(torch.arange(count) + 100, position, velocity, density)


def fault(particles):
    return find_fault(particles, LIMITS, PeriodicBox(LENGTH), step=12, rank=3)


@pytest.mark.parametrize("count", [0, 1, 6])
def test_a_sound_state_has_no_fault(count):
    assert fault(sound(count)) is None


@pytest.mark.parametrize(
    "name, value, complaint",
    [
        ("position", torch.nan, "not finite"),
        ("velocity", torch.inf, "not finite"),
        ("density", torch.nan, "not finite"),
        ("velocity", 50.0, "faster than 20"),
        ("density", 2.0, "farther than 0.5"),
    ],
)
def test_a_faulty_particle_is_described(name, value, complaint):
    particles = sound()
    column = getattr(particles, name).clone()
    column[4] = value
    description = fault(dataclasses.replace(particles, **{name: column}))
    for part in (complaint, "step 12", "rank 3", "particle 104", "position", "velocity", "density"):
        assert part in description
    assert "nearest particle" in description or name == "position"


def test_particles_without_a_density_have_none_that_could_be_wrong():
    particles = dataclasses.replace(sound(), density=None)
    limits = Limits(speed=20.0)
    assert find_fault(particles, limits, PeriodicBox(LENGTH), step=1, rank=0) is None
    particles.velocity[2] = torch.nan
    description = find_fault(particles, limits, PeriodicBox(LENGTH), step=1, rank=0)
    assert "particle 102: not finite" in description and "density" not in description
    infinite = dataclasses.replace(sound(), density=torch.full((6,), torch.inf, dtype=torch.float64))
    assert "not finite" in find_fault(infinite, limits, PeriodicBox(LENGTH), step=1, rank=0)


def test_the_nearest_particle_is_found_across_the_faces():
    particles = sound(3)
    position = torch.tensor([[0.1, 1, 1], [3, 3, 3], [LENGTH - 0.2, 1, 1]], dtype=torch.float64)
    velocity = particles.velocity.clone()
    velocity[0] = torch.nan
    description = fault(dataclasses.replace(particles, position=position, velocity=velocity))
    assert "nearest particle 102 at a distance of 0.3" in description


@pytest.mark.parametrize("distance, complaint", [(torch.inf, "not finite"),
                                                 (1.01 * LENGTH, "farther outside its slab than the box is long")])
def test_a_particle_that_is_nowhere_near_its_slab_is_described(distance, complaint):
    particles, box, outside = sound(), PeriodicBox(LENGTH), torch.full((6,), LENGTH, dtype=torch.float64)
    assert find_unplaced(particles, outside, box, rank=3) is None
    outside[4] = distance
    description = find_unplaced(particles, outside, box, rank=3)
    assert description.startswith(f"rank 3, particle 104: {complaint}; position (")
    described = find_unplaced(dataclasses.replace(particles, density=None), outside, box, rank=3)
    assert described.startswith(f"rank 3, particle 104: {complaint}; position (")
