"""Sentences on rollouts that need care, and what moved their particles."""

import pytest

from eddies.report.figures import Variant
from eddies.report.rollouts import moved_by, rollout_numbers, section, with_same_truth

WHOLE = {"status": "complete", "stable": True, "turnovers": 1.0, "last_common_time": 1.0}
ATTRIBUTES = {"eddy_turnover_time": 1.2, "start_time": 0.6, "method": "none", "integrator": "verlet", "turnovers": 1.0}


def measured(label="one", not_compared="", truth="id", attributes=ATTRIBUTES, **numbers):
    """A variant without tables."""
    return Variant(label, ("red", "o"), {"rollout": {**WHOLE, **numbers}, "attributes": attributes, "truth": truth,
                                         "not_compared": not_compared, "reconstructed_by": ""}, {})


@pytest.mark.parametrize("given, words", [
    ({}, ()),
    ({"status": "stopped: here", "turnovers": 0.5, "last_common_time": 0.5}, (
        "one: The rollout stopped: here (last frame at 0.5 T)",)),
    ({"not_compared": "no truth"}, ("not compared with the truth: no truth. Its status: complete.",)),
    ({"broken": 0.333}, ("not finite from 0.333 T on",)), ({"last_common_time": 0.4}, ("tracers end at 0.4 T",)),
    ({"closure_not_converged": 2, "closure_residual": 1e-3}, ("2 solves", "1.0e-03")),
    ({"attributes": {**ATTRIBUTES, "injection_rate": 0.5}}, (
        "The model is forced with a power of 0.5 per mass, and the flow of the true tracers is not forced",))])
def test_what_needs_care_is_said(given, words):
    notices = section([measured(**given)], [{}], 0).notices
    assert len(notices) == bool(words) and all(text in notices[0] for text in words)


def test_variants_with_the_same_notice_share_it_and_others_are_counted():
    found = section([measured("one", broken=0.5), measured("two", broken=0.5)], [{}, {}], 3)
    notice, = found.notices
    assert notice.startswith("one, two: ") and "3 more variants" in found.text


def test_only_variants_with_the_truth_of_the_first_are_drawn_together():
    one, other, later = measured("one"), measured("two", truth="another"), measured(
        "three", attributes={**ATTRIBUTES, "start_time": 0.7})
    assert with_same_truth([one, other, later, one]) == [one, one]


def test_numbers_of_a_rollout_name_what_moved_the_particles_and_what_is_missing():
    numbers = rollout_numbers(measured(not_compared="no truth").numbers, {})
    assert numbers["method"].startswith("no force") and numbers["velocity_error"] is numbers["stage_seconds"] is None
    grid = {"method": "eulerian", "cells": 16, "largest_wavenumber": 5, "fluid": "f", "equations": "e", "closure": "c"}
    assert "16³ cells" in moved_by(grid) and moved_by(grid).endswith("started from the flow")
