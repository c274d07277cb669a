"""Training and coefficients in the section on models."""

import numpy as np

from eddies.report.models import coefficient_metrics, source_metrics, training_metrics
from eddies.report.page import side_by_side

PHASES = [{"phase": "one step", "steps": 40, "seconds": 1.5, "error": 0.2},
          {"phase": "horizon 4", "steps": 8, "seconds": 2.0, "error": 0.1}]
COEFFICIENTS = {"eddy-viscosity": [
    {"name": "|a_1|", "learned": 0.1, "value": 0.25, "unit": "L/T", "meaning": "friction of a pair"}],
    "damping": [{"name": "D", "learned": [0.1, 0.2], "value": [0.1, 0.2], "unit": "1", "meaning": "rates"}]}


def test_a_training_has_its_cost_and_error_by_phase():
    seconds, steps, errors = training_metrics({"training": PHASES})
    assert seconds.value == 3.5 and steps.value == {"one step": 40, "horizon 4": 8}
    assert errors.value == {"one step": 0.2, "horizon 4": 0.1}


def test_weights_without_their_cost_differ_from_a_model_without_training():
    assert {(each.value, each.reason) for each in training_metrics({})} == {(None, "not stored with these weights")}
    assert [each.value for each in training_metrics({"training": []})] == [0.0, None, None]


def test_missing_numbers_of_the_source_have_a_reason():
    errors = {"delay": np.array([-0.1, 0.0]), "acceleration_error": np.array([0.2, 0.3])}
    for metric in source_metrics(None, errors, None, errors):
        assert metric.value is None
        assert ("not stored with these weights" if "mach" in metric.key else "window below 1") in metric.reason


def test_coefficients_are_written_as_learned_and_in_the_units_of_the_flow():
    one, several = coefficient_metrics({"coefficients": COEFFICIENTS})
    assert (one.key, one.label) == ("eddy-viscosity |a_1|", "eddy-viscosity, |a_1|: friction of a pair")
    assert one.written == "0.1, that is 0.25 L/T" and several.written == "0.1, 0.2"
    assert one.value["value"] == 0.25 and one.value["unit"] == "L/T"
    row, = side_by_side({"resolved": [one]})
    assert row.label == one.label and row.value == {"resolved": "0.1, that is 0.25 L/T"}
