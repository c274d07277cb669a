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

import eddies
from tests.small_scene import TINY

CHECKOUT = Path(__file__).parents[1]
EXAMPLES = CHECKOUT / "docs" / "examples"
SMALL = ["flow.cells=16", "spin_up.turnovers=0.1", "tracers.particles_per_side=8", "tracers.field_cells=12",
         "tracers.turnovers=0.3", "tracers.field_every=4", "kernel.neighbors=30", "kernel.steps=4", "kernel.points=50",
         "training.steps=8", "training.combined_steps=2", "training.frames=2", "training.batch=64",
         "simulation.turnovers=0.05", "simulation.frame_interval=0.08", "simulation.step=0.08"]


def results(directory):
    """Metrics of the report, and terms and weights of the model."""
    metrics = json.loads((directory / "report" / "metrics.json").read_text())
    assert metrics["rollout"]["status"] == "complete" and math.isfinite(metrics["model"]["acceleration_error"])
    with h5py.File(directory / "model.h5") as file:
        weights = {name: values[()] for name, values in file["weights"].items()}
        return metrics, json.loads(file.attrs["description"])["terms"], weights


@pytest.fixture
def smaller(tmp_path, monkeypatch, no_figures, quick_solves):
    """The working directory, in which scenes are smaller."""
    load = eddies.load_scene
    monkeypatch.setattr(eddies, "load_scene", lambda name, overrides, removals=(): load(
        name, [*overrides, *SMALL], removals))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def example(comm, smaller, examples):
    """A function that runs an example with smaller scenes and returns its run directory."""
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
    assert caplog.text.count("rollout: complete") == 2
    assert list(results(smaller / "runs" / "mine")[1]) == ["pressure", "relaxation", "pairs"]


@pytest.mark.mpi(1)
def test_a_term_of_the_users(example):
    run = example("own_term")
    metrics, terms, weights = results(run)
    assert list(terms) == ["pressure", "own_term:SmagorinskyStress", "viscosity", "relaxation", "pairs"]
    assert metrics["rollout"]["method"].endswith("pressure, SmagorinskyStress, viscosity, relaxation, pairs")
    learned = weights["terms.SmagorinskyStress.squared_constant"]
    assert learned.shape == () and learned > 0 and learned != np.float32(0.17**2)
    assert "own_term:" in (run / "scene.toml").read_text()  # the scene of a run names the classes of the user


@pytest.mark.mpi(2)
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


@pytest.fixture
def examples(monkeypatch):
    """Make the examples importable."""
    monkeypatch.setattr(sys, "path", [*sys.path, str(EXAMPLES)])


@pytest.mark.mpi(2)
@pytest.mark.parametrize("constant", [0.0, 0.3])
def test_the_stress_of_the_example_is_linear_as_it_says(comm, examples, constant):
    """The stored linear part gives the same rates and gradients as the term."""
    import torch

    from eddies.flow.tracers import release
    from eddies.parallel.reduction import global_sum
    from eddies.parallel.slab import SlabDecomposition
    from eddies.particles.dynamics import ParticleDynamics
    from eddies.particles.particle_set import ParticleSet
    from tests.learning.models import LENGTH, SPACING, model_of

    terms = ("pressure", "own_term:SmagorinskyStress", "pairs")
    model = model_of(terms, 1.6 * SPACING, 17, (4,))
    slab = SlabDecomposition(comm, LENGTH, 12)
    columns = release(slab, 3, 12, "random")
    x, y, z = columns["position"].T
    velocity = np.stack([np.sin(y) + np.cos(2 * z), np.sin(z), np.sin(2 * x)], axis=1)
    particles = ParticleSet.from_numpy({**columns, "velocity": velocity})
    dynamics = ParticleDynamics(slab, model, 0.0, torch.float64)
    kept = model.linear_rates(dynamics.context(particles))
    assert set(kept) == {"pressure", "SmagorinskyStress"}
    parameter = model.terms["SmagorinskyStress"].squared_constant
    with torch.no_grad():
        parameter.fill_(constant**2)
    found = []
    for given in (kept, None):
        rates = dynamics.rates(particles, kept=given)
        rates.acceleration.square().sum().backward()
        found.append((rates.acceleration.detach(), rates.density.detach(),
                      torch.tensor(global_sum(comm, float(parameter.grad)))))
        parameter.grad = None
    for linear, direct in zip(*found):
        assert torch.allclose(linear, direct, rtol=1e-10, atol=1e-12 * float(direct.abs().max()))
    assert constant == 0 or float(found[0][0].square().mean()) > 0


@pytest.mark.mpi(2)
def test_a_term_that_returns_nothing_is_one_error(comm, own):
    from eddies.parallel.slab import SlabDecomposition
    from eddies.particles.dynamics import ParticleDynamics
    from eddies.particles.particle_set import ParticleSet
    from tests.learning.models import LENGTH, model_of

    own("wrong", "import eddies\n\nclass Mine(eddies.Term):\n    def forward(self, context): pass\n")
    dynamics = ParticleDynamics(SlabDecomposition(comm, LENGTH, 6), model_of(("wrong:Mine",), 1.5, 20, (4,)), 0.0)
    at_rest = ParticleSet.from_numpy({"id": np.array([comm.rank]), "position": np.ones((1, 3)),
                                      "velocity": np.zeros((1, 3))})
    with pytest.raises(eddies.TermError, match="Mine: forward returns a NoneType"):
        dynamics.rates(at_rest)


@pytest.mark.mpi(2)
def test_a_wrong_initial_flow_is_one_error(comm, tmp_path, own):
    if comm.rank == 0:
        own("wrong", "import numpy\n\ndef flow(grid, initial, seed):\n    return numpy.zeros((3, 4, 4, 4))\n")
    comm.Barrier()
    scene = eddies.load_scene(TINY, [*SMALL, "initial.kind=wrong:flow", "initial.peak_wavenumber=3"])
    with pytest.raises(eddies.SceneError, match=r'\[initial\] kind = "wrong:flow": returned'):
        eddies.run(scene, output=tmp_path / "run", comm=comm)
