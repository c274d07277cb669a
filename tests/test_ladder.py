"""The rungs of the ladder: their terms give what they state, on any number of ranks."""

import importlib.util
import json
import shutil
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import torch

import eddies
from eddies.workflows.learned.model import initial_model
from eddies.workflows.learned.source import ModelDefinition
from tests.particles.configurations import SCALES, alone, assert_close, by_id, distributed, dynamics_of, given, state

LADDER = Path(__file__).parents[1] / "docs" / "ladder" / "ladder.toml"
RUNGS = "nearest-60", "density-constant", "density-of-pressure", "density-decay", "shift", "shift-alone", "to-neighbors"
ITERATIONS = 6
COUNT = 3000  # particles, which have 88 neighbours on average within the radius of "nearest-60"


def rung(comm, name):
    """The model of a rung with initial parameters, in double precision."""
    return initial_model(ModelDefinition.of(eddies.load_scene(LADDER).variant[name]), SCALES, comm)


@torch.no_grad()
def rates_of(slab, particles, model):
    """Rates of all particles by id. Those of a few rows, as in training, are equal."""
    dynamics = dynamics_of(slab, model, iterations=ITERATIONS)
    found, rows = given(dynamics.rates(particles)), torch.arange(0, len(particles), 100)
    for name, rate in given(dynamics.rates(particles, rows)).items():
        assert_close(rate, found[name] if name == "density" else found[name][rows], 1e-11)
    return {name: by_id(slab.comm, particles, rate, COUNT) for name, rate in found.items()}


@pytest.mark.mpi(2)
@pytest.mark.parametrize("name", RUNGS)
def test_rates_of_a_rung_do_not_depend_on_the_ranks(comm, name):
    columns, model = state(COUNT), rung(comm, name)
    found, expected = (rates_of(*placed, model) for placed in (distributed(comm, *columns), alone(*columns)))
    assert found.keys() == expected.keys() >= {"acceleration"}
    for quantity, reference in expected.items():
        assert torch.isfinite(reference).all()
        assert_close(found[quantity], reference, 1e-11)
    assert ("shift_velocity" in found) == name.startswith("shift")
    assert name != "density-constant" or not found["density_rate"].any()


@pytest.mark.mpi(1)
def test_the_force_is_that_of_the_sixty_nearest(comm):
    """A neighbour beyond them changes nothing, one among them does."""
    position, velocity, density = state(COUNT)
    model = rung(comm, "nearest-60")
    slab, particles = alone(position, velocity, density)
    before = rates_of(slab, particles, model)["acceleration"][0]
    apart = slab.length * ((position - position[0]) / slab.length + 0.5).remainder(1) - slab.length / 2
    order = apart.norm(dim=1).argsort()
    for place, same in ((62, True), (30, False)):
        changed = velocity.clone()
        changed[order[place]] += 1.0
        after = rates_of(*alone(position, changed, density), model)["acceleration"][0]
        assert torch.equal(after, before) == same


@pytest.mark.mpi(1, 2)
def test_noise_of_the_training_belongs_to_the_particle(comm):
    """It does not depend on the ranks, differs at each evaluation, and vanishes without gradients."""
    columns, model, same = state(COUNT), rung(comm, "noise"), rung(comm, "noise")

    def accelerations(placed, noisy):
        slab, particles = placed
        found = dynamics_of(slab, noisy, iterations=ITERATIONS).rates(particles).acceleration.detach()
        return by_id(slab.comm, particles, found, COUNT)

    first, second = (accelerations(distributed(comm, *columns), model) for _ in range(2))
    assert_close(first, accelerations(alone(*columns), same), 1e-11)
    with torch.no_grad():
        exact = accelerations(alone(*columns), same)
    # Two draws differ by sqrt(2) times what one adds: 0.05 u' / (d / 2 u') in the force alone.
    least = 0.05 * 2 * SCALES.velocity ** 2 / SCALES.filter_width
    assert (first - exact).std() > least / 2 and (second - first).std() > least / 2


@pytest.fixture
def table():
    """docs/ladder/table.py, imported."""
    spec = importlib.util.spec_from_file_location("table", LADDER.parent / "table.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_results_of_a_rung_without_rollouts_are_kept(table, tmp_path, monkeypatch, capsys):
    (tmp_path / "own").mkdir()
    shutil.copy(LADDER, tmp_path / "own" / "scene.toml")
    results = {"rows": [{"name": "paper", "velocity_error_end": 0.83}, {"name": "no rung of this scene"}]}
    (tmp_path / "own.json").write_text(json.dumps(results))
    monkeypatch.setattr(table, "RESULTS", tmp_path)
    monkeypatch.syspath_prepend(LADDER.parent)
    table.main(tmp_path / "own", timed=False)
    assert json.loads((tmp_path / "own.json").read_text())["rows"] == results["rows"][:1]
    assert "paper: as before" in capsys.readouterr().out


def test_the_learning_curve_of_rollouts_has_the_errors_of_the_weights_that_are_kept(table, monkeypatch):
    """Two phases at single moments, then 2 and 4 frames: a phase without a smaller error keeps that of its start."""
    nan = np.nan
    history = {"phase": np.array([0.0, 1, 2, 2, 2, 3, 3]),
               "start_error": np.array([1.1, 0.95, 0.9, nan, nan, 0.7, nan]),
               "validation_error": np.array([0.4, 0.9, nan, 0.7, 0.8, nan, 0.75])}
    stored = {f"history/{name}": values for name, values in history.items()}
    monkeypatch.setattr(table, "open_product", lambda *_: nullcontext(stored))
    horizons = table.Horizons(frames=(2, 4), steps=3)
    assert table.horizon_errors(Path("model.h5"), horizons) == {"0": 0.9, "2": 0.7, "4": 0.7}
