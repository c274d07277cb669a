import numpy as np
import pytest

from eddies.report.figures import MODEL, png
from eddies.report.learning import curves


def history(phases, **columns):
    """A history of phases with these numbers of steps, 2 s per step."""
    steps = sum(phases)
    return {"phase": np.repeat(np.arange(len(phases)), phases).astype(float), "step": np.arange(float(steps)),
            "seconds": 2.0 * np.arange(1, steps + 1), "learning_rate": np.full(steps, 1e-3),
            "loss": np.linspace(2, 1, steps), "gradient_norm": np.ones(steps), **columns}


def drawn(phases, **columns):
    """The figure of one training."""
    return curves({"": (history(phases, **columns), MODEL)})


def circled(axis):
    return [(line.get_xdata()[0], line.get_ydata()[0]) for line in axis.lines if line.get_markersize() == 8]


def test_phases_are_equally_wide_and_ticks_count_steps_and_seconds():
    figure = drawn([1000, 4])
    axis = figure.axes[0]
    first, second = (line.get_xdata() for line in axis.lines if line.get_alpha())  # single steps of the loss
    assert (first[0], first[-1]) == pytest.approx((1e-3, 1)) and second == pytest.approx([1.25, 1.5, 1.75, 2])
    labels = [label.get_text() for label in axis.get_xticklabels()]
    assert labels == ["0", "500\n16 min 40 s", "1000\n33 min 20 s", "1002\n33 min 24 s", "1004\n33 min 28 s"]


def test_each_phase_has_its_least_error_circled():
    errors = np.array([np.nan, 0.5, 0.3, 0.4, 0.9, np.nan, 0.8])
    axis = drawn([4, 3], validation_error=errors).axes[1]
    assert circled(axis) == [(0.75, 0.3), (2.0, 0.8)]


def test_a_phase_without_improvement_has_its_start_circled():
    errors, starts = np.array([np.nan, 0.5, np.nan, np.inf, 0.9]), np.array([0.7, np.nan, 0.4, np.nan, np.nan])
    axis = drawn([2, 3], validation_error=errors, start_error=starts).axes[1]
    assert circled(axis) == [(1.0, 0.5), (1.0, 0.4)]


@pytest.mark.filterwarnings("error")
def test_a_history_of_one_step_without_anything_positive_is_drawn():
    nothing = drawn([1], loss=np.zeros(1), gradient_norm=np.zeros(1), energy_loss=np.full(1, np.nan))
    assert png(nothing).startswith(b"\x89PNG\r\n\x1a\n")


def test_several_trainings_have_a_curve_each_over_their_phases():
    losses, errors = curves({"one": (history([4]), "red"), "two": (history([3, 2]), "blue")}).axes
    assert losses.get_legend_handles_labels()[1] == ["one", "two"] and not errors.lines
    assert [line.get_xdata()[-1] for line in losses.lines if line.get_alpha()] == pytest.approx([1, 1, 2])
