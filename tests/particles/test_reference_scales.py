from dataclasses import replace

import pytest

from eddies.particles.reference_scales import ReferenceScales
from tests.particles.configurations import SCALES


def test_scales_survive_a_dictionary():
    assert ReferenceScales(**SCALES.to_dict()) == SCALES


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_a_scale_that_cannot_divide_is_refused(value):
    with pytest.raises(ValueError, match="velocity"):
        replace(SCALES, velocity=value)
