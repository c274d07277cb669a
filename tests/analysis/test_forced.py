import numpy as np
import pytest

from eddies.analysis.forced import forced_averages
from eddies.analysis.isotropic_turbulence import StationarySpan
from eddies.analysis.rollout import Rollout
from eddies.analysis.velocity_gradients import Invariants

WIDTH, SPECTRUM = np.pi / 4, np.exp(-0.5 * np.arange(10))
# Velocity of the model over that of the flow, with two frames a turnover. The last seven frames are averaged.
FACTORS = np.array([1.0] + 6 * [1.3] + [1.0, 1.2] + 5 * [1.1])


class Stored:
    """Particles whose columns are given ones times a factor for each frame."""

    def __init__(self, columns, factors):
        self.columns, self.factors, self.times = columns, factors, 0.5 * np.arange(len(factors))

    def read(self, frame, column, start=0, stop=None):
        return self.factors[frame] * self.columns[column][start:stop]


def rollout(factors=FACTORS):
    """A model whose velocities are those of the flow at the start times a factor for each frame."""
    random = np.random.default_rng(3)
    columns = {name: random.standard_normal((500, 3)) for name in ("position", "velocity", "acceleration")}
    gradient = random.standard_normal((500, 3, 3))
    attributes = {"eddy_turnover_time": 1.0, "injection_rate": 0.5, "start_time": 0.0}
    runs = {"model": Stored(columns, factors), "truth": Stored(columns, np.ones(1))}
    spectra = {name: dict(enumerate(np.outer(run.factors**2, SPECTRUM[:8]))) for name, run in runs.items()}
    gradients = {name: {frame: Invariants.of(factor * gradient) for frame, factor in enumerate(run.factors)}
                 for name, run in runs.items()}
    flow = {"time": runs["model"].times}
    return Rollout(attributes, *runs.values(), flow, {"filter_width": WIDTH}, spectra, gradients), columns


def stationary():
    """A span with three times, whose filtered spectra are 0.8, 1 and 1.2 times SPECTRUM."""
    unfiltered = SPECTRUM * np.exp((np.arange(10) * WIDTH) ** 2 / 12)
    statistics = {"time": np.array([0.0, 1.0, 2.0]), "turnovers": np.array([0.0, 1.0, 2.0])}
    return StationarySpan(statistics, np.outer([0.8, 1.0, 1.2], unfiltered), 0.01, 0.0, 2.0, 2.0)


def test_a_model_that_is_the_stationary_flow_but_for_a_factor():
    run, columns = rollout()
    value, tables = forced_averages(run, stationary())
    energy = 0.5 * columns["velocity"].var(axis=0).sum()
    # The second half, three turnovers, are three blocks: with the factors 1 and 1.2, twice 1.1, three times 1.1.
    found = value["energy"]
    blocks = np.array([(1 + 1.2**2) / 2, 1.1**2, 1.1**2])
    assert found["model"] == pytest.approx(energy * blocks.mean())
    assert found["standard error"] == pytest.approx(energy * np.std(blocks, ddof=1) / np.sqrt(3))
    assert found["deviation"] == pytest.approx(energy * np.std(FACTORS[7:] ** 2))
    assert abs(found["trend per turnover"]) < found["error of the trend"]
    # The samples count a quarter, a half and a quarter.
    whole = SPECTRUM.sum()
    assert found["stationary flow"] == pytest.approx(whole, rel=1e-12)
    assert found["its deviation"] == pytest.approx(whole * 0.2 / np.sqrt(2), rel=1e-12)
    assert found["its standard error"] == pytest.approx(whole * 0.15)  # of two blocks, 0.8 and (1 + 1.2) / 2
    error = value["spectrum_error"]
    assert error["model"] == pytest.approx(np.log(blocks.mean()))
    # The error of a logarithm is nearly the relative error.
    assert error["standard error"] == pytest.approx(found["standard error"] / found["model"], rel=0.01)
    rms = value["acceleration_rms"]
    assert rms["model"] == pytest.approx(1.1 * rms["flow at the start"], rel=1e-12)
    for name in ("velocity_kl", "acceleration_kl", "qr_kl"):
        assert value[name] == pytest.approx(0, abs=1e-9)
    spectra = tables["forced_spectra"]
    assert spectra["energy_model"] == pytest.approx(blocks.mean() * spectra["energy_flow"])
    assert tables["forced_accelerations"]["model"] == pytest.approx(tables["forced_accelerations"]["truth"])


def test_frames_after_the_first_broken_one_do_not_count():
    """The averages are those of the frames 1 and 2."""
    run, columns = rollout(np.array([1.0, 1.2, 1.2, np.nan, 1.2]))
    value, _ = forced_averages(run, stationary())
    assert value["energy"]["model"] == pytest.approx(1.2**2 * 0.5 * columns["velocity"].var(axis=0).sum())
    assert value["spectrum_error"] == {"model": pytest.approx(2 * np.log(1.2)),
                                       "standard error": pytest.approx(np.nan, nan_ok=True)}


def test_a_rollout_that_broke_at_once_is_not_compared():
    run, _ = rollout(np.array([np.nan, 1.0]))
    assert forced_averages(run, stationary()) == ({}, {})


def test_true_tracers_that_are_forced_too_are_averaged_over_the_same_time():
    """But not if they are not forced, or end before."""
    run, _ = rollout()
    alike = {**vars(run), "attributes": {**run.attributes, "truth_injection_rate": 0.5}}
    longer = Stored(run.truth.columns, np.append(FACTORS, [9.0, 9.0]))
    found, _ = forced_averages(Rollout(**{**alike, "truth": longer}), stationary())
    for name in ("energy", "acceleration_rms"):
        assert found[f"true_{name}"]["true tracers"] == found[name]["model"]
        assert found[f"true_{name}"]["standard error"] == found[name]["standard error"]
    for others in (alike, {**vars(run), "truth": longer}):
        assert "true_energy" not in forced_averages(Rollout(**others), stationary())[0]
