"""The measures of a rollout against known errors."""

import numpy as np
import pytest

from eddies.analysis.rollout import Rollout
from eddies.analysis.rollout_measures import measures
from eddies.analysis.velocity_gradients import Invariants
from eddies.measures import MEASURES

TURNOVER, TIMES = 1.2, np.linspace(0, 1.2, 7)
LENGTH, RNG = 2 * np.pi, np.random.default_rng(4)
VELOCITY, ACCELERATION, GRADIENT = (RNG.normal(size=(4000, *shape)) for shape in ((3,), (3,), (3, 3)))
VELOCITY, ACCELERATION = (rows - rows.mean(axis=0) for rows in (VELOCITY, ACCELERATION))
START = RNG.uniform(0, LENGTH, (4000, 3))
SPECTRUM = np.exp(-np.arange(9.0))
KL_FLOORS = {"velocity_kl_floor", "acceleration_kl_floor", "qr_kl_floor"}
DRIFTS = {"momentum_drift", "density_drift", "count_variance"}


class Stored:
    """Particles that move; velocities and accelerations are those of the truth times 1 + growth * time."""

    columns, length, total = ("position", "velocity", "acceleration"), LENGTH, 4000

    def __init__(self, growth=0.0, times=TIMES, broken=None):
        self.growth, self.times, self.broken = growth, times, broken

    def read(self, frame, column, start=0, stop=None):
        time = self.times[frame]
        factor = np.nan if frame == self.broken else 1 + self.growth * time
        values = {"position": (START + (factor - 1 + 0.2 * time) * VELOCITY) % LENGTH,
                  "velocity": factor * (VELOCITY + time * ACCELERATION), "acceleration": factor * ACCELERATION}
        return values[column][start:stop]


def measured(growth, complete=True, model_times=TIMES, broken=None):
    """The measures of a model whose velocities, with their spectra and gradients, grow too fast."""
    attributes = {"eddy_turnover_time": TURNOVER, "start_time": 3.0, "turnovers": 1.0,
                  "status": "complete" if complete else "stopped: x"}
    runs = {"model": Stored(growth, model_times, broken), "truth": Stored()}
    spectra = dict.fromkeys(("energy", "filtered"), np.tile(SPECTRUM, (4, 1)))
    flow = {"time": TIMES[::2] + 3.0, "wavenumber": np.arange(9), **spectra}
    factors = {name: 1 + run.growth * run.times for name, run in runs.items()}
    spectra = {name: dict(enumerate(np.outer(factor**2, SPECTRUM))) for name, factor in factors.items()}
    gradients = {name: {frame: Invariants.of(one * GRADIENT) for frame, one in enumerate(factor)}
                 for name, factor in factors.items()}
    run = Rollout(attributes, *runs.values(), flow, {"kolmogorov_time": 0.15, "filter_width": np.pi / 6.0}, spectra,
                  gradients)
    return measures(run, None)[0]["accuracy"]


def test_the_truth_itself_has_no_error():
    found = measured(0.0)
    assert found.pop("end") == 1 and list(found) == list(MEASURES)
    assert found.pop("energy_ratio") == 1
    floors = KL_FLOORS | DRIFTS | {f"{name}_floor" for name in DRIFTS}
    assert all(found[name] == pytest.approx(0, abs=1e-12) for name in found.keys() - floors)
    assert all(1e-4 < found[name] < 0.1 for name in KL_FLOORS)
    assert all(found[name] == found[f"{name}_floor"] for name in DRIFTS)
    assert found["momentum_drift"] > 0 and found["density_drift"] is None


def test_an_error_that_grows_in_time_is_interpolated_between_frames():
    found = measured(0.1)
    # Frames are at 0.2, 0.4, ...; t_eta = 0.15 and T/2 = 0.6. The error is linear in time.
    assert found["velocity_error_early"] == pytest.approx(0.015)
    assert found["velocity_error_half"] == pytest.approx(0.06)
    assert found["velocity_error_end"] == pytest.approx(0.12)
    assert found["acceleration_error"] == 0
    assert found["energy_ratio"] == pytest.approx(1.12**2)
    assert found["spectrum_error"] == pytest.approx(2 * np.log(1.12)) and found["spectrum_error_floor"] == 0
    assert found["acceleration_variance_error"] == pytest.approx(2 * np.sqrt(np.mean(np.log(1 + 0.1 * TIMES) ** 2)))
    assert found["acceleration_correlation_error"] == pytest.approx(0, abs=1e-12)
    assert found["pair_dispersion_error"] == pytest.approx(2 * np.log(1.5))  # particles move 1.5 times as far
    assert all(found[name] > 1e-4 for name in ("velocity_kl", "acceleration_kl", "qr_kl"))


def test_times_that_are_not_reached_have_no_number():
    stopped = measured(0.1, complete=False, model_times=TIMES[:3])
    assert stopped["end"] == pytest.approx(1 / 3)
    assert {name for name in MEASURES if stopped[name] is not None} == {"velocity_error_early", "acceleration_error"}
    broken = measured(0.1, broken=2)
    assert broken["end"] == pytest.approx(0.2 / TURNOVER) and broken["velocity_error_half"] is None
    assert broken["velocity_error_early"] == pytest.approx(0.015) and broken["velocity_kl"] is None
    assert set(measured(0.1, complete=False, broken=0).values()) == {None}
