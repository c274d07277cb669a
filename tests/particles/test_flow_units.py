from dataclasses import replace

import numpy as np
import pytest

from eddies.particles.flow_units import FlowUnits, ReferenceScales, measured_scales
from eddies.scene.terms import TermError
from tests.particles.configurations import CUTOFF, NEIGHBORS, SCALES, model


def test_scales_survive_a_dictionary():
    assert ReferenceScales(**SCALES.to_dict()) == SCALES


@pytest.mark.mpi(1, 2)
def test_measured_scales_are_those_of_plain_numpy_and_count_a_mean_velocity(comm):
    random = np.random.default_rng(4)
    velocity, density = random.normal(size=(2, 10, 3)), 1 + 0.01 * random.normal(size=(2, 10))
    own = slice(comm.rank * 3, 3 if comm.rank < comm.size - 1 else None)

    def measured(wind):
        return measured_scales(comm, *({"velocity": velocity[frame][own] + wind, "density": density[frame][own]}
                                       for frame in (0, 1)), 0.1)

    def rms(values):
        return pytest.approx(np.sqrt(np.mean(values**2)), rel=1e-12)

    wind = np.array([3.0, 0.0, -1.0])
    rates = {"acceleration_rms": rms((velocity[1] - velocity[0]) / 0.1),
             "density_rms": rms(density[0] - 1), "density_rate_rms": rms((density[1] - density[0]) / 0.1)}
    assert measured(0.0) == {"velocity_rms": rms(velocity[0]), **rates}
    assert measured(wind) == {"velocity_rms": rms(velocity[0] + wind), **rates}


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_a_scale_that_cannot_divide_is_refused(value):
    with pytest.raises(ValueError, match="velocity"):
        replace(SCALES, velocity=value)


def test_a_scale_of_the_density_is_wanted_where_there_is_none():
    incompressible = replace(SCALES, density=None, density_rate=None, sound_speed=None)
    assert SCALES.required("sound_speed") == 11.0
    with pytest.raises(ValueError, match="sound_speed: a flow without density has none"):
        incompressible.required("sound_speed")
    with pytest.raises(TermError, match='term "wcsph": cannot be made: .* sound_speed: a flow without density'):
        model({"density-flux": {}, "wcsph": {}}, FlowUnits(incompressible, CUTOFF, NEIGHBORS))
