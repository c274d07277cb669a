"""The measures of a rollout against errors that are put in."""

import numpy as np
import pytest

from eddies.analysis.accuracy import MEASURES, StoredRollout, accuracy

TURNOVER, TIMES = 1.2, np.linspace(0, 1.2, 7)
CELLS, RNG = 8, np.random.default_rng(4)
VELOCITY, ACCELERATION, GRADIENT = (RNG.normal(size=(4000, *shape)) for shape in ((3,), (3,), (3, 3)))
FIELD = RNG.normal(size=(3, CELLS, CELLS, CELLS))


class Stored:
    """The same particles or field at all times, times 1 + growth * time."""

    def __init__(self, columns, growth=0.0, times=TIMES, broken=None):
        self.columns, self.growth, self.times, self.broken = columns, growth, times, broken

    def read(self, frame, column, start=0, stop=None):
        factor = np.nan if frame == self.broken else 1 + self.growth * self.times[frame]
        return factor * self.columns[column][start:stop]


PARTICLES = {"velocity": VELOCITY, "acceleration": ACCELERATION, "velocity_gradient": GRADIENT}


def measured(growth, complete=True, model_times=TIMES, broken=None):
    model = Stored(PARTICLES, growth, model_times, broken), Stored({"velocity": FIELD}, growth, model_times)
    truth = Stored(PARTICLES), Stored({"velocity": FIELD})
    run = StoredRollout(model[0], truth[0], model[1], truth[1], TURNOVER, 0.15, filter_wavenumber=6.0)
    return accuracy(run, complete)


def test_the_truth_itself_has_no_error():
    found = measured(0.0)
    assert found.pop("energy_ratio") == 1 and found.pop("end") == 1
    assert set(found) == set(MEASURES) - {"energy_ratio"}
    assert all(value == pytest.approx(0, abs=1e-12) for value in found.values())


def test_an_error_that_grows_in_time_is_found_between_frames():
    found = measured(0.1)
    # Frames stand at 0.2, 0.4, ...: t_eta = 0.15 and T/2 = 0.6; the error is exactly linear in time.
    assert found["velocity_error_early"] == pytest.approx(0.015)
    assert found["velocity_error_half"] == pytest.approx(0.06)
    assert found["acceleration_error"] == 0
    assert found["energy_ratio"] == pytest.approx(1.12**2)
    assert found["spectrum_error"] == pytest.approx(1.12**2 - 1)
    assert all(found[name] > 1e-4 for name in ("velocity_kl", "acceleration_kl", "qr_kl"))


def test_what_is_not_reached_has_no_number():
    found = measured(0.1, complete=False, model_times=TIMES[:3])
    assert found["end"] == pytest.approx(1 / 3)
    known = {name for name in MEASURES if found[name] is not None}
    assert known == {"velocity_error_early", "acceleration_error"}


def test_frames_from_the_first_that_is_not_finite_on_do_not_count():
    found = measured(0.1, broken=2)
    assert found["end"] == pytest.approx(0.2 / TURNOVER) and found["velocity_error_half"] is None
    assert found["velocity_error_early"] == pytest.approx(0.015) and found["velocity_kl"] is None


def test_a_rollout_without_a_finite_frame_has_no_numbers():
    assert set(measured(0.1, complete=False, broken=0).values()) == {None}
