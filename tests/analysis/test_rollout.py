"""Common frames of a rollout and its truth, and the times of its spectra."""

from dataclasses import replace

import numpy as np
import pytest

from eddies.analysis.rollout import Rollout

SHELLS, CELLS = np.arange(6), 12


class Still:
    """Particles at rest; the velocities of frame `broken` are NaN."""

    columns = ("velocity", "acceleration")

    def __init__(self, times, broken=None):
        self.times, self.broken = np.array(times), broken

    def read(self, frame, column, start=0, stop=None):
        return np.full((4, 3), np.nan if frame == self.broken else 0.0)


def rollout(model=(0.0, 0.5, 1.0, 1.5), truth=(0.0, 0.5, 1.0), flow=(0.0, 1.0, 1.5, 2.0, 2.5), broken=None, shells=9):
    """Spectra e^t 2^-k of the flow at time t, 1.2 times as large for the model, 0.9 times for the truth."""
    def energies(times, size, factor=1.0):
        return factor * np.exp(np.asarray(times))[:, None] * 0.5 ** np.arange(size)

    spectra = {name: dict(enumerate(energies(times, 6, factor)))
               for name, times, factor in (("model", model, 1.2), ("truth", truth, 0.9))}
    table = {"time": np.array(flow), "wavenumber": np.arange(shells), "filtered": energies(flow, shells)}
    return Rollout({"start_time": 1.0, "eddy_turnover_time": 1.0}, Still(model, broken), Still(truth), table,
                   {"kolmogorov_time": 0.1}, spectra, None)


def test_spectra_at_a_common_frame():
    run = rollout()
    assert run.spectral().tolist() == [0, 1, 2] and run.shown_spectra().tolist() == [0, 1, 2]
    model, truth, filtered = run.spectra_at(2)
    assert truth == pytest.approx(0.9 * np.e * 0.5**SHELLS) and model == pytest.approx(1.2 * np.e * 0.5**SHELLS)
    assert run.flow_row(2) == 3 and filtered == pytest.approx(np.e**2 * 0.5**SHELLS)
    # Only the shells that all have.
    assert [spectrum.size for spectrum in rollout(shells=5).spectra_at(0)] == [5, 5, 5]


def test_frames_without_a_spectrum_of_the_flow():
    """The flow is stored at times 0 and 1 of the rollout; the truth ends at 1."""
    run = rollout(flow=(1.0, 2.0))
    assert run.spectral().tolist() == [0, 2] and run.late_spectra().tolist() == [2, 3]
    assert rollout(flow=(1.0,), truth=(0.0, 0.5, 1.0, 1.5)).late_spectra().tolist() == [0]
    assert rollout(broken=3).late_spectra().tolist() == [1, 2]


def test_common_frames_before_the_model_broke():
    run = rollout(model=(0.0, 0.25, 0.5, 1.0), broken=3)
    assert run.broken == 1.0 and run.common.model.tolist() == [0, 2] and run.common.truth.tolist() == [0, 1]
    assert run.before_broken("model").tolist() == [0, 1, 2] and run.before_broken("truth").tolist() == [0, 1]
    for alone in (rollout(broken=0), rollout(truth=(7.0,))):
        with pytest.raises(ValueError, match="no time at which"):
            alone.common


@pytest.mark.parametrize("end, expected", [
    (21, [0, 1, 5, 10, 20]),  # times 0, 0.1, T/2 = 0.5, T = 1 and the end 2
    (11, [0, 1, 5, 10]),      # the end is T
    (12, [0, 1, 5, 11]),      # and is so close to T that both need no column
    (4, [0, 1, 3]),
    (1, [0]),
])
def test_the_times_of_figures_are_those_of_the_table(end, expected):
    times = np.arange(end) / 10
    run = rollout(model=times, truth=times, flow=1 + times)
    assert run.shown(np.arange(end)).tolist() == expected
    assert run.shown_spectra().tolist() == expected
    if end == 21:  # only even frames have a spectrum of the flow
        assert rollout(times, times, 1 + times[::2]).shown_spectra().tolist() == [0, 4, 10, 20]


@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_frames_and_spectra_are_matched_in_any_unit_of_time(unit):
    """The frames of a rollout are not simultaneous because their interval is a small number."""
    scaled = {"model": (0.0, 0.5, 1.0, 1.5), "truth": (0.0, 0.5 + 1e-9, 1.0), "flow": (0.0, 1.0, 1.5, 2.0, 2.5)}
    run = rollout()
    model, truth = (Still(unit * np.array(scaled[name])) for name in ("model", "truth"))
    run = replace(run, attributes={"start_time": unit}, model=model, truth=truth,
                  flow={**run.flow, "time": unit * np.array(scaled["flow"])})
    assert [rows.tolist() for rows in (run.common.model, run.common.truth)] == [[0, 1, 2], [0, 1, 2]]
    assert run.spectral().tolist() == [0, 1, 2]
