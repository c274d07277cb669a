"""What the report says of a model beside its errors: its training and its coefficients."""

from eddies.report.model import _coefficients, _training
from eddies.report.page import Metric, RunRecord, Section, metrics_json, render_page

PHASES = [{"phase": "one step", "steps": 40, "seconds": 1.5, "error": 0.2},
          {"phase": "horizon 4", "steps": 8, "seconds": 2.0, "error": 0.1}]
COEFFICIENTS = {"eddy-viscosity": [
    {"name": "|a_1|", "learned": 0.1, "value": 0.25, "unit": "L/T", "meaning": "friction of a pair"}],
    "damping": [{"name": "D", "learned": [0.1, 0.2], "value": [0.1, 0.2], "unit": "1", "meaning": "rates"}]}


def test_the_cost_of_a_training_is_told_by_phase():
    seconds, steps, errors = _training({"training": PHASES})
    assert seconds.value == 3.5 and steps.value == {"one step": 40, "horizon 4": 8}
    assert errors.value == {"one step": 0.2, "horizon 4": 0.1}


def test_what_is_not_stored_is_told_apart_from_what_did_not_have_to_be_learned():
    assert {each.value for each in _training({})} == {None}
    assert {each.reason for each in _training({})} == {"not stored with these weights"}
    assert [each.value for each in _training({"training": []})] == [0.0, None, None]


def test_coefficients_are_written_as_learned_and_in_the_units_of_the_flow():
    one, several = _coefficients({"coefficients": COEFFICIENTS})
    assert (one.key, one.label) == ("eddy-viscosity |a_1|", "eddy-viscosity, |a_1|: friction of a pair")
    assert one.written == "0.1, that is 0.25 L/T" and several.written == "0.1, 0.2"
    section = Section("model", "Model", metrics=[Metric("delay", "delay", 0.1), one])
    record = RunRecord("run", "", "", [("stage",)])
    assert '"value": 0.25,\n      "unit": "L/T"' in metrics_json(record, [section])
    assert "0.1, that is 0.25 L/T" in render_page(record, [section])
