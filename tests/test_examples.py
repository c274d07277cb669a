"""The examples of the documentation train, run and report, from any directory."""

import json
import logging
import math
import re
import runpy
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

import eddies
from eddies.workflows.diff import numbers_of

CHECKOUT = Path(__file__).parents[1]
EXAMPLES = CHECKOUT / "docs" / "examples"
SMALL = ["flow.cells=16", "spin_up.turnovers=0.1", "tracers.particles_per_side=8", "tracers.field_cells=12",
         "tracers.turnovers=0.3", "tracers.field_every=4", "kernel.neighbors=30", "kernel.steps=4", "kernel.points=50",
         "training.steps=8", "training.combined_steps=2", "training.frames=2", "training.batch=64",
         "simulation.turnovers=0.05", "simulation.frame_interval=0.08", "simulation.step=0.08"]


def results(directory):
    """Metrics of the report, and terms and weights of the model."""
    metrics = numbers_of(directory, None)
    assert metrics["rollouts"]["status"] == "complete" and math.isfinite(metrics["models"]["acceleration_error"])
    with h5py.File(directory / "model.h5") as file:
        weights = {name: values[()] for name, values in file["weights"].items()}
        return metrics, json.loads(file.attrs["description"])["terms"], weights


@pytest.fixture
def smaller(tmp_path, monkeypatch, no_figures, quick_solves, quick_spectra):
    """The working directory, in which scenes are smaller."""
    load = eddies.load_scene
    monkeypatch.setattr(eddies, "load_scene", lambda name, overrides, removals=(): load(
        name, [*overrides, *SMALL], removals))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def example(comm, smaller, monkeypatch):
    """A function that runs an example with smaller scenes and returns its run directory."""
    monkeypatch.setattr(sys, "path", [*sys.path, str(EXAMPLES)])

    def run(name):
        runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
        comm.Barrier()
        return smaller / "runs" / name.replace("_", "-")

    return run


@pytest.mark.mpi(1)
def test_ten_lines_set_a_rollout_going(smaller, caplog, monkeypatch):
    page = (CHECKOUT / "docs/python.md").read_text(encoding="utf-8")
    program = re.search(r"^```python\n(import dataclasses\n.*?)^```", page, re.MULTILINE | re.DOTALL)[1]
    with caplog.at_level(logging.INFO, "eddies"):
        exec(compile(program, "python.md", "exec"), {})
    assert caplog.text.count("; complete\n") == 2
    assert list(results(smaller / "runs" / "mine")[1]) == ["pressure", "relaxation", "pairs"]


@pytest.mark.mpi(1)
def test_a_term_of_the_users(example):
    run = example("own_term")
    metrics, terms, weights = results(run)
    assert list(terms) == ["pressure", "own_term:SmagorinskyStress", "viscosity", "relaxation", "pairs"]
    assert metrics["rollouts"]["method"].endswith("pressure, SmagorinskyStress, viscosity, relaxation, pairs")
    learned = weights["terms.SmagorinskyStress.squared_constant"]
    assert learned.shape == () and learned > 0 and learned != np.float32(0.17**2)
    assert "own_term:" in (run / "scene.toml").read_text()  # the scene of a run names the classes of the user


@pytest.mark.mpi(2)
def test_a_pair_term_of_the_users(example):
    run = example("own_pair_force")
    _, terms, weights = results(run)
    assert [*terms] == ["own_pair_force:PairForce", "eddy-viscosity", "density-flux", "density-diffusion"]
    with torch.random.fork_rng():
        torch.manual_seed(1)  # the seed of tiny
        start = torch.nn.Linear(5, 20).weight.detach().numpy()
    learned = weights["terms.PairForce.network.0.weight"]
    assert learned.shape == (20, 5) and 0 < np.abs(learned - start).max() < 0.5


@pytest.mark.mpi(1)
def test_a_network_of_the_users(example):
    run = example("own_network")
    _, terms, weights = results(run)
    assert terms["pairs"]["network"] == "own_network:Waves"
    assert weights["terms.pairs.network.wavevectors"].shape == (80, 5)  # the invariants of Eq. 4
    assert "own_network:" in (run / "scene.toml").read_text()


@pytest.mark.mpi(1)
def test_a_flow_of_the_users(example):
    run = example("own_initial_flow")
    metrics, *_ = results(run)
    # The short spin-up hardly changes the start, which has an rms of 1 in each component.
    assert metrics["ground_truth"]["energy_budget_error"] < 1e-2
    with h5py.File(run / "ground_truth.h5") as file:
        energies = [file[f"statistics/energy_{axis}"][0] for axis in "xyz"]
    assert energies == pytest.approx([energies[0]] * 3, rel=1e-6) and sum(energies) == pytest.approx(1.5, rel=1e-3)
