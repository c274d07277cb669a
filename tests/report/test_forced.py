import numpy as np
import pytest

from eddies.analysis.isotropic_turbulence import StationarySpan
from eddies.analysis.spectra import energy_spectrum
from eddies.report.figures import png
from eddies.report.forced import ForcedStatistics, section
from eddies.report.rollout import Rollout

CELLS, WIDTH, ATTENUATED = 12, np.pi / 4, 0.9
FACTORS = np.array([1.0, 1.3, 1.1, 1.1, 1.1])  # of the model's velocity over that of the flow, by frame


class Stored:
    """Frames of columns that are given, each times a factor."""

    def __init__(self, columns, factors):
        self.columns, self.factors, self.times = columns, factors, 0.5 * np.arange(len(factors))

    def read(self, frame, column, start=0, stop=None):
        return self.factors[frame] * self.columns[column][start:stop]


def rollout(factors=FACTORS):
    """A model that is the flow at its start times factors, and fields that a kernel attenuates evenly."""
    random = np.random.default_rng(3)
    columns = {name: random.standard_normal((500, *shape)) for name, shape in
               (("velocity", (3,)), ("acceleration", (3,)), ("velocity_gradient", (3, 3)))}
    field = {"velocity": random.standard_normal((3, CELLS, CELLS, CELLS))}
    fields = {"model": Stored(field, ATTENUATED * factors), "truth": Stored(field, np.array([ATTENUATED])),
              "filtered": Stored(field, np.ones(1))}
    attributes = {"eddy_turnover_time": 1.0, "injection_rate": 0.5}
    run = Rollout(attributes, Stored(columns, factors), Stored(columns, np.ones(1)), fields, 2 * np.pi, WIDTH, None)
    return run, columns, field["velocity"]


def stationary(field):
    """A span whose filtered spectrum is that of a field, times 0.8, 1 and 1.2 at three times."""
    wavenumber, energy = energy_spectrum(field)
    unfiltered = energy * np.exp((wavenumber * WIDTH) ** 2 / 12)
    statistics = {"time": np.array([0.0, 1.0, 2.0]), "turnovers": np.array([0.0, 1.0, 2.0])}
    return StationarySpan(statistics, np.outer([0.8, 1.0, 1.2], unfiltered), 0.01, 0.0, 2.0, 2.0)


def test_a_model_that_is_the_stationary_flow_but_for_a_factor():
    run, columns, field = rollout()
    shown = section(run, stationary(field))
    value = {metric.key: metric.value for metric in shown.metrics}
    energy = 0.5 * np.mean(np.sum(columns["velocity"] ** 2, axis=1))
    # The second half are the last three of five frames, all with the factor 1.1.
    found = value["energy"]
    assert (found["model"], found["deviation"]) == pytest.approx((1.21 * energy, 0), abs=1e-12)
    # The samples count a quarter, a half and a quarter.
    _, spectrum = energy_spectrum(field)
    whole = spectrum.sum()
    assert found["stationary flow"] == pytest.approx(whole, rel=1e-12)
    assert found["its deviation"] == pytest.approx(whole * 0.2 / np.sqrt(2), rel=1e-12)
    assert value["spectrum_error"] == pytest.approx(0.21, rel=1e-12)
    rms = value["acceleration_rms"]
    assert rms["model"] == pytest.approx(1.1 * rms["flow at the start"], rel=1e-12)
    for name in ("velocity_kl", "acceleration_kl", "qr_kl"):
        assert value[name] == pytest.approx(0, abs=1e-9)
    assert png(shown.illustrations[0].image).startswith(b"\x89PNG")


def test_frames_after_the_first_broken_one_do_not_count():
    run, _, field = rollout(np.array([1.0, 1.2, 1.2, np.nan, 1.2]))
    found = ForcedStatistics.of(run, stationary(field))
    assert found.times.tolist() == [0, 0.5, 1.0] and found.late.tolist() == [1, 2]


def test_a_rollout_that_broke_at_once_is_not_compared():
    run, _, field = rollout(np.array([np.nan, 1.0]))
    shown = section(run, stationary(field))
    assert shown.notices == ["It is not compared: the model has no finite frame."] and not shown.metrics


def test_only_a_rollout_with_an_injection_is_forced():
    run, *_ = rollout()
    assert run.forced
    for attributes in ({}, {"injection_rate": 0.0}):
        assert not Rollout(**{**vars(run), "attributes": attributes}).forced
