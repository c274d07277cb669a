from dataclasses import replace

import pytest

from eddies.particles.flow_units import FlowUnits, ReferenceScales
from eddies.scene.terms import TermError
from tests.particles.configurations import CUTOFF, NEIGHBORS, SCALES, model


def test_scales_survive_a_dictionary():
    assert ReferenceScales(**SCALES.to_dict()) == SCALES


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
