"""The verdict of a report: what it says of good, mixed and poor numbers, and of those that tell nothing."""

import pytest

from eddies.report.page import Metric, Section
from eddies.report.verdict import arranged, section

GOOD = {"stable": True, "status": "complete", "early_time": 0.5, "early_velocity_error": 0.04,
        "early_velocity_error_no_force": 0.85, "energy_ratio": 0.99, "energy_ratio_no_force": 1.8,
        "spectrum_error": 0.02, "spectrum_error_floor": 0.003, "acceleration_kl": 0.001,
        "acceleration_kl_floor": 0.0007, "qr_kl": 0.02, "qr_kl_floor": 0.026}


def verdict(warned=False, **changed):
    """The verdict's words, and the marks by measure, on a rollout that is good but for some numbers."""
    found = section({"rollout": of("rollout", GOOD | changed)}, warned)
    return found.text, {metric.key: metric.value["verdict"] for metric in found.metrics}


def of(key, numbers):
    return Section(key, key, metrics=[Metric(name, name, value) for name, value in numbers.items()])


def test_good_numbers_are_called_so():
    text, marks = verdict()
    assert text.startswith("The rollout is good in all that it is judged by: velocities, energy, spectrum,")
    assert set(marks.values()) == {"good"} and len(marks) == 5


# An error of half of that of no force is fair, that of no force itself poor, whatever its size.
@pytest.mark.parametrize("changed, key, mark", [
    ({"early_velocity_error": 0.4}, "velocity", "fair"), ({"early_velocity_error": 0.85}, "velocity", "poor"),
    ({"energy_ratio": 1.05}, "energy", "fair"), ({"energy_ratio": 0.5}, "energy", "poor"),
    ({"spectrum_error": 0.3}, "spectrum_error", "poor"), ({"acceleration_kl": 0.8}, "acceleration_kl", "poor"),
    ({"acceleration_kl": 0.02, "acceleration_kl_floor": 0.015}, "acceleration_kl", "good"),
    ({"qr_kl": 0.1}, "qr_kl", "fair")])
def test_each_number_has_a_say(changed, key, mark):
    text, marks = verdict(**changed)
    assert marks.pop(key) == mark and set(marks.values()) == {"good"}
    assert (mark == "good") == ("all that it is judged by" in text) and f"The rollout is {mark} in " in text


def test_a_rollout_that_broke_is_poor_and_one_of_another_flow_not_judged():
    text, _ = verdict(stable=False, status="stopped: particle 3 is too fast")
    assert text.startswith("Poor: the rollout did not come to its end (stopped: particle 3 is too fast).")
    text, marks = verdict(two_flows=True)
    assert "not judged by the true tracers" in text and "good" not in text and not marks


def test_of_a_short_rollout_little_is_made():
    text, marks = verdict(early_time=0.05, early_velocity_error=0.01, early_velocity_error_no_force=0.08)
    assert "compared for 0.05 turnovers alone, which asks little of it" in text and "too short to judge them" in text
    assert marks["velocity"] == "not judged" and "velocities," not in text


def test_model_and_kernel_are_held_against_what_needs_no_training():
    model = of("model", {"acceleration_error": 0.3, "filtered_pressure_gradient_error": 0.35})
    kernel = of("kernel", {"velocity_error": 0.2, "cubic_spline_velocity_error": 0.19, "wendland_velocity_error": 0.17,
                           "gradient_error": 0.3, "cubic_spline_gradient_error": 0.4})
    text = section({"model": model, "kernel": kernel}, warned=True).text
    assert "There is no rollout to judge." in text and "0.3 (exact filtered pressure gradient: 0.35): poor." in text
    assert "is worse than those that need no training (0.2; Wendland: 0.17)" in text and "better than those" in text
    assert text.endswith("The warnings above come first: these numbers may not belong together.")


def test_the_rollout_stands_before_the_flow_and_what_is_behind_is_folded():
    given = [of(key, {}) for key in ("ground_truth", "kernel", "cost")] + [of("rollout", GOOD)]
    ordered = arranged(given, warned=False)
    assert [each.key for each in ordered] == ["verdict", "rollout", "kernel", "cost", "ground_truth"]
    assert [each.folded for each in ordered] == [False, False, True, True, True]
    assert [each.key for each in arranged(given[:1], warned=False)] == ["ground_truth"]
