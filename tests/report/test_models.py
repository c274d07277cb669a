"""Training and coefficients in the section on models."""

import numpy as np
import pytest

from eddies.report.figures import Variant
from eddies.report.models import numbers_of, section, unseen_error

PHASES = [{"phase": "one step", "steps": 40, "seconds": 1.5, "error": 0.2},
          {"phase": "horizon 4", "steps": 8, "seconds": 2.0, "error": 0.1}]
COEFFICIENTS = {"eddy-viscosity": [
    {"name": "|a_1|", "learned": 0.1, "value": 0.25, "unit": "L/T", "meaning": "friction of a pair"}],
    "damping": [{"name": "D", "learned": [0.1, 0.2], "value": [0.1, 0.2], "unit": "1", "meaning": "rates"}]}
ERRORS = {"delay": np.array([-0.1, 0.0]), "acceleration_error": np.array([0.2, 0.3])}


def model(**description):
    """A model as the report reads it from its file."""
    return Variant("one", ("red", "o"), {"terms": ["pairs"], "provenance": {}, "others": [], **description},
                   {"a_priori": ERRORS})


def test_a_training_has_its_cost_and_error_by_phase():
    found = numbers_of(model(training=PHASES))
    assert found["training_seconds"] == 3.5 and found["training_steps"] == {"one step": 40, "horizon 4": 8}
    assert found["training_error"] == {"one step": 0.2, "horizon 4": 0.1} and found["acceleration_error"] == 0.3


@pytest.mark.parametrize("description, seconds", [({}, None), ({"training": []}, 0.0)])
def test_weights_without_their_cost_differ_from_a_model_without_training(description, seconds):
    found = numbers_of(model(**description))
    assert [found[f"training_{key}"] for key in ("seconds", "steps", "error")] == [seconds, None, None]


def test_an_error_after_the_training_needs_frames_after_the_training():
    assert unseen_error(ERRORS) is None
    assert unseen_error({**ERRORS, "delay": np.array([0.1, 0.2])}) == 0.25


@pytest.mark.usefixtures("no_figures")
def test_coefficients_are_written_as_learned_and_in_the_units_of_the_flow():
    rows = dict(section([model(coefficients=COEFFICIENTS)]).table)
    assert rows["eddy-viscosity |a_1|: friction of a pair"] == "0.1, that is 0.25 L/T"
    assert rows["damping D: rates"] == "0.1, 0.2"
    found = numbers_of(model(coefficients=COEFFICIENTS))["eddy-viscosity |a_1|"]
    assert found == {"learned": 0.1, "value": 0.25, "unit": "L/T", "meaning": "friction of a pair"}
