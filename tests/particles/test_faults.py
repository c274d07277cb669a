from dataclasses import replace

import pytest
import torch

from eddies.particles.faults import Limits, find_fault
from eddies.particles.particle_set import ParticleSet
from eddies.particles.periodic_box import PeriodicBox
from tests.particles.configurations import LENGTH, state

LIMITS = Limits(speed=20.0, frame=torch.zeros(3), density_mean=1.0, density_deviation=0.5)
BOX = PeriodicBox(LENGTH)


def sound(count=6):
    return ParticleSet(torch.arange(count) + 100, *state(count))


def fault(particles):
    return find_fault(particles, LIMITS, BOX, step=12, rank=3)


def test_a_sound_state_has_no_fault():
    for particles in (sound(), sound(0), replace(sound(1), density=None)):
        assert fault(particles) is None


@pytest.mark.parametrize("name, value, complaint", [
    ("position", torch.nan, "not finite"), ("velocity", torch.inf, "not finite"), ("density", torch.nan, "not finite"),
    ("velocity", 50.0, "speed above the limit 20"), ("density", 2.0, "differs by more than 0.5")])
def test_a_faulty_particle_is_described(name, value, complaint):
    particles = sound()
    getattr(particles, name)[4] = value
    description = fault(particles)
    for part in (complaint, "step 12", "rank 3", "particle 104", "position", "velocity", "density"):
        assert part in description
    assert "nearest particle" in description or name == "position"


def test_the_nearest_particle_is_found_across_the_faces():
    position = torch.tensor([[0.1, 1, 1], [3, 3, 3], [LENGTH - 0.2, 1, 1]], dtype=torch.float64)
    particles = replace(sound(3), position=position, density=None)
    particles.velocity[0] = torch.nan
    assert "nearest particle 102 at a distance of 0.3" in fault(particles)
