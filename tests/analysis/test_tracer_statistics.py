import numpy as np
import pytest

from eddies.analysis.tracer_statistics import tracer_statistics

LENGTH, TOTAL, SPACING = 2 * np.pi, 12**3, 2 * np.pi / 12


class Drifting:
    """Tracers with constant accelerations, and positions that move with their first velocities."""

    length, total = LENGTH, TOTAL

    def __init__(self, frames=9, acceleration=lambda random: random.normal(size=(TOTAL, 3))):
        random = np.random.default_rng(8)
        self.times = 0.7 + 0.05 * np.arange(frames)
        self.start = random.uniform(0, LENGTH, (TOTAL, 3))
        self.first, self.acceleration = random.normal(size=(TOTAL, 3)), acceleration(random)

    def read(self, frame, column, start=0, stop=None):
        time = self.times[frame] - self.times[0]
        values = {"velocity": self.first + time * self.acceleration,
                  "position": (self.start + time * self.first) % LENGTH}
        return values[column][start:stop]


def spectra(energy):
    """Spectra of a field with this energy in one shell, at two of the frames."""
    return {"time": np.array([0.7, 0.9]), "filtered": np.array([[0, energy], [0, energy]])}


def test_known_tracers():
    tracers = Drifting()
    found = tracer_statistics(tracers, spectra(1.5 * np.mean(np.var(tracers.first, axis=0))), SPACING)
    assert found.energy_ratio[0] == pytest.approx(1.0)
    # At time 0.2 the variance of the velocities has grown by that of the acceleration times 0.2^2.
    assert found.energy_ratio[1] == pytest.approx(1.04, abs=0.02)
    assert found.energy_error[0] == pytest.approx(np.sqrt(2 / 3 / TOTAL), rel=0.1)
    assert found.acceleration_rms == pytest.approx(np.sqrt(np.mean(tracers.acceleration**2)))
    assert found.kurtosis == pytest.approx(3, abs=0.2)
    assert found.structure_exponent == pytest.approx(2) and found.lags[0] == pytest.approx(0.05)
    assert found.structure == pytest.approx(found.lags**2 * np.mean(tracers.acceleration**2))
    assert found.ballistic_exponent == pytest.approx(2) and found.ballistic_prefactor == pytest.approx(1)
    distances = np.array([pairs.distance for pairs in found.dispersion])
    assert distances == pytest.approx(SPACING * np.array([0.5, 1, 2, 4]))


def test_uniform_accelerations_have_a_kurtosis_of_nine_fifths():
    flat = Drifting(acceleration=lambda random: random.uniform(-1, 1, (TOTAL, 3)))
    found = tracer_statistics(flat, spectra(1.5), SPACING)
    assert found.kurtosis == pytest.approx(1.8, abs=0.05)
    assert found.probability.sum() * 0.2 == pytest.approx(1)


def test_two_frames_have_no_exponents():
    found = tracer_statistics(Drifting(frames=2), spectra(1.5), SPACING)
    assert np.isnan(found.structure_exponent) and np.isnan(found.ballistic_exponent)
    assert found.ballistic_prefactor == pytest.approx(1)


def test_constant_velocities_have_no_kurtosis():
    steady = Drifting(acceleration=lambda random: np.zeros((TOTAL, 3)))
    found = tracer_statistics(steady, spectra(1.5), SPACING)
    assert found.acceleration_rms == 0 and not found.probability.any()
    assert np.isnan(found.kurtosis) and np.isnan(found.structure_exponent)
    assert found.ballistic_exponent == pytest.approx(2)
