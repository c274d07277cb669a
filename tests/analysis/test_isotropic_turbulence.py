import numpy as np
import pytest

from eddies.analysis.isotropic_turbulence import (
    StationarySpan, acceleration_constant, comparison, dissipation_constant, gradient_flatness, gradient_skewness,
    modes_per_shell,
)

VISCOSITY, DISSIPATION, CUTOFF, MACH = 0.01, 0.5, 12, 0.1
ETA = (VISCOSITY**3 / DISSIPATION) ** 0.25


def columns(time):
    """Energies grow linearly in time, every other column is constant."""
    constant = {"dissipation_rate": DISSIPATION, "injection_rate": 0.75, "kolmogorov_length": ETA,
                "kmax_eta": CUTOFF * ETA, "reynolds_lambda": 80.0, "skewness": -0.5, "flatness": 5.0,
                "integral_scale": 1.2, "velocity_rms": 1.1, "time_step": 0.02, "mach_turbulent": MACH,
                "density_rms": 0.3 * MACH**2, "compressible_fraction": (0.2 * MACH**2) ** 2}
    growing = {"energy_x": 0.6, "energy_y": 0.5, "energy_z": 0.4, "energy": 1.5, "total_energy": 2.5}
    return {"time": time, "turnovers": time / 1.25,
            **{name: np.full(time.size, value) for name, value in constant.items()},
            **{name: value * (1 + 0.1 * time) for name, value in growing.items()}}


def span_of(statistics, spectra=None, forced_below=2.0):
    """The span from t = 2 to 7."""
    spectra = np.ones((statistics["time"].size, CUTOFF + 9)) if spectra is None else spectra
    return StationarySpan(statistics, spectra, VISCOSITY, 2.0, 7.0, forced_below)


# Samples every 0.1 and then every 0.5.
UNEVEN = np.concatenate([np.arange(0, 4, 0.1), np.arange(4, 10, 0.5)])


def test_literature():
    assert gradient_skewness(100.0) == pytest.approx(-0.531, abs=1e-3)
    assert gradient_flatness(100.0) == pytest.approx(5.457, abs=1e-3)
    assert dissipation_constant(92.0) == pytest.approx(0.483, abs=1e-3)
    assert dissipation_constant(1e6) == pytest.approx(0.4)
    assert acceleration_constant(110.0) == 2.5


def test_modes_per_shell():
    k = np.stack(np.meshgrid(*[np.arange(-8, 9)] * 3)).reshape(3, -1)
    counted = np.bincount(np.rint(np.linalg.norm(k, axis=0)).astype(int))[:8]
    assert np.array_equal(modes_per_shell(7), counted)


def test_averages_are_over_time_and_not_over_samples():
    span = span_of(columns(UNEVEN))
    assert span.turnovers == pytest.approx(4.0)
    assert span.mean("energy") == pytest.approx(1.5 * 1.45)  # linear growth: its value at t = 4.5
    mean, deviation = span.average(span.columns["energy"])
    assert deviation == pytest.approx(0.15 * 5 / np.sqrt(12), rel=0.02)
    assert span.steps_per_turnover == pytest.approx(1.25 / 0.02)


def test_energy_budget_and_trend():
    span = span_of(columns(UNEVEN))
    assert span.energy_imbalance == pytest.approx(0, abs=1e-12)  # injected 0.75, dissipated 0.5, grows by 0.25
    # Four turnovers of a straight line: four blocks without scatter.
    assert span.energy_trend.value == pytest.approx(0.15 * 1.25 / (1.5 * 1.45))
    assert span.energy_trend.error == pytest.approx(0, abs=1e-12)
    lossy = {**columns(UNEVEN), "injection_rate": np.full(UNEVEN.size, 0.8)}
    assert span_of(lossy).energy_imbalance == pytest.approx(0.1)


def test_a_compensated_kolmogorov_spectrum_is_flat():
    """The means leave out the forced shells."""
    k = np.arange(CUTOFF + 9.0)
    energy = 1.6 * DISSIPATION ** (2 / 3) * np.maximum(k, 1) ** (-11 / 3) * modes_per_shell(k.size - 1) / (4 * np.pi)
    energy[1:3] *= 10
    span = span_of(columns(UNEVEN), np.tile(energy, (UNEVEN.size, 1)))
    k_eta, compensated = span.compensated_spectrum()
    assert np.allclose(k_eta, ETA * np.arange(1, CUTOFF + 1))
    assert np.allclose(compensated, [16.0] * 2 + [1.6] * (CUTOFF - 2))
    rows = {row.key: row for row in comparison(span)}
    assert rows["compensated_spectrum"].value == pytest.approx(1.6) and rows["bottleneck"].value == pytest.approx(1.6)


def test_the_table_of_a_known_flow():
    rows = {row.key: row for row in comparison(span_of(columns(UNEVEN)))}
    assert rows["dissipation_constant"].value == pytest.approx(0.5 * 1.2 / 1.1**3)
    assert rows["dissipation_constant"].literature == pytest.approx(dissipation_constant(80.0))
    assert [rows[f"share_{axis}"].value for axis in "xyz"] == pytest.approx([1.2, 1.0, 0.8])
    assert rows["share_x"].deviation == pytest.approx(0, abs=1e-12)
    assert rows["density_rms_over_mach_squared"].value == pytest.approx(0.3)
    assert rows["compressible_velocity_over_mach_squared"].value == pytest.approx(0.2)


def test_skewness_from_the_production_of_enstrophy():
    """All energy in one shell: <|grad w|^2> is k^2 times the enstrophy W, which decays at a known rate."""
    time, k, rate = np.linspace(0, 10, 201), 4, 0.3
    enstrophy = DISSIPATION / VISCOSITY * np.exp(-rate * time)
    spectra = np.zeros((time.size, CUTOFF + 9))
    spectra[:, k] = enstrophy / (2 * k**2)
    span = span_of({**columns(time), "dissipation_rate": VISCOSITY * enstrophy}, spectra)
    produced = (VISCOSITY * k**2 - rate / 2) * enstrophy[40:141]
    expected = -produced / (17.5 * (enstrophy[40:141] / 15) ** 1.5)
    assert span.enstrophy_skewness()[1:-1] == pytest.approx(expected[1:-1], rel=1e-3)


def test_an_incompressible_flow_has_no_mach_number():
    statistics = columns(UNEVEN)
    del statistics["mach_turbulent"]
    assert not any("mach" in row.key or "compressible" in row.key for row in comparison(span_of(statistics)))
    with pytest.raises(ValueError, match="2 samples"):
        span_of(columns(np.array([0.0, 3.0, 6.0, 9.0])))
