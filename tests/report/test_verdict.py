"""The verdict of a report."""

import pytest

from eddies.report.page import Metric, Section
from eddies.report.verdict import arranged, section

GOOD = {"stable": True, "status": "complete", "early_time": 0.5, "early_velocity_error": 0.04,
        "early_velocity_error_no_force": 0.85, "energy_ratio": 0.99, "energy_ratio_no_force": 1.8,
        "spectrum_error": 0.02, "spectrum_error_floor": 0.003, "acceleration_kl": 0.001,
        "acceleration_kl_floor": 0.0007, "qr_kl": 0.02, "qr_kl_floor": 0.026}


def verdict(warned=False, **changed):
    """Text and marks for a rollout that is good except for some numbers."""
    found = section({"rollout": part("rollout", GOOD | changed)}, warned)
    return found.text, {metric.key: metric.value["verdict"] for metric in found.metrics}


def part(key, numbers):
    return Section(key, key, metrics=[Metric(name, name, value) for name, value in numbers.items()])


# Half the error without any force is fair, an error as large as that is poor.
@pytest.mark.parametrize("changed, key, mark", [
    ({}, "velocity", "good"),
    ({"early_velocity_error": 0.4}, "velocity", "fair"), ({"early_velocity_error": 0.85}, "velocity", "poor"),
    ({"energy_ratio": 1.05}, "energy", "fair"), ({"energy_ratio": 0.5}, "energy", "poor"),
    ({"spectrum_error": 0.3}, "spectrum_error", "poor"), ({"acceleration_kl": 0.8}, "acceleration_kl", "poor"),
    ({"acceleration_kl": 0.02, "acceleration_kl_floor": 0.015}, "acceleration_kl", "good"),
    ({"qr_kl": 0.1}, "qr_kl", "fair")])
def test_each_number_has_a_mark(changed, key, mark):
    text, marks = verdict(**changed)
    assert marks.pop(key) == mark and set(marks.values()) == {"good"} and len(marks) == 4
    assert [word for word in ("poor", "fair") if word in text] == [mark] * (mark != "good")


def test_a_rollout_that_broke_is_poor_and_one_of_another_flow_is_not_judged():
    text, _ = verdict(stable=False, status="stopped: particle 3 is too fast")
    assert text.startswith("Poor: ") and "stopped: particle 3 is too fast" in text
    text, _ = verdict(stable=False, status="complete")
    assert text.startswith("Poor: the rollout has values that are not finite.")
    text, marks = verdict(two_flows=True)
    assert "not judged" in text and "good" not in text and not marks


def test_velocities_of_a_short_rollout_are_not_judged():
    text, marks = verdict(early_time=0.05, early_velocity_error=0.01, early_velocity_error_no_force=0.08)
    assert "0.05 turnovers" in text and "Velocities are not judged" in text and marks["velocity"] == "not judged"


def test_model_and_kernel_are_compared_with_methods_without_training():
    model = part("model", {"acceleration_error": 0.3, "filtered_pressure_gradient_error": 0.35})
    kernel = part("kernel", {"velocity_error": 0.2, "cubic_spline_velocity_error": 0.19,
                             "wendland_velocity_error": 0.17,
                             "gradient_error": 0.35, "cubic_spline_gradient_error": 0.35})
    text = section({"model": model, "kernel": kernel}, warned=True).text
    assert "no rollout" in text and "0.3, poor (the exact filtered pressure gradient alone: 0.35)" in text
    assert "velocity error 0.2, worse than the Wendland kernel (0.17)." in text
    assert "gradient error 0.35, about as good as the cubic spline (0.35)." in text and "warnings" in text


def test_the_rollout_comes_first_and_other_sections_are_folded():
    given = [part(key, {}) for key in ("ground_truth", "kernel", "cost")] + [part("rollout", GOOD)]
    ordered = arranged(given, warned=False)
    assert [each.key for each in ordered] == ["verdict", "rollout", "kernel", "cost", "ground_truth"]
    assert [each.folded for each in ordered] == [False, False, True, True, True]
    assert [each.key for each in arranged(given[:1], warned=False)] == ["ground_truth"]
