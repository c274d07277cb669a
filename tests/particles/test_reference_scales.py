import json
from dataclasses import replace

import pytest
from clouds import SCALES

from eddies.particles.reference_scales import ReferenceScales


def test_scales_survive_a_dictionary():
    assert ReferenceScales.from_dict(SCALES.to_dict()) == SCALES


def test_a_flow_without_density_has_no_scales_of_it():
    scales = replace(SCALES, density=None, density_rate=None, sound_speed=None)
    stored = json.loads(json.dumps(scales.to_dict()))
    assert stored["density"] is None and ReferenceScales.from_dict(stored) == scales


@pytest.mark.parametrize("name", ["velocity", "density", "density_rate", "sound_speed"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_a_scale_that_cannot_divide_is_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} = {value}: must be finite and positive"):
        replace(SCALES, **{name: value})


def test_a_fluid_may_be_inviscid_but_no_less():
    assert replace(SCALES, viscosity=0.0).viscosity == 0
    for value in (-1e-3, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="viscosity"):
            replace(SCALES, viscosity=value)


def test_missing_and_unknown_scales_are_refused():
    with pytest.raises(ValueError, match="expected"):
        ReferenceScales.from_dict({**SCALES.to_dict(), "mass": 1.0})
