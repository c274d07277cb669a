"""Rollouts without a learned force: free particles, WCSPH, and a coarse Eulerian flow."""

import logging

import numpy as np
import pytest
from mpi4py import MPI

from eddies.io.weights import load_weights
from eddies.report.rollouts import moved_by
from eddies.scene.scene import SceneError, load_scene
from eddies.workflows import train
from eddies.workflows import simulate as stage
from eddies.workflows.rollout.measured import open_rollout
from tests.commands import first_rank
from tests.workflows.small_rollout import prepared

pytestmark = pytest.mark.usefixtures("unmeasured")

SCENE = ["flow.cells=16", "flow.viscosity=0.05", "kernel.neighbors=30", "simulation.method=none",
         "simulation.turnovers=0.2"]
COARSE = ["simulation.method=eulerian", "eulerian.cells=12"]
SMOOTHED = ['model.terms=["continuity", "wcsph"]', "training.steps=0", "training.frames=2", "training.batch=60",
            "simulation.method=learned", "simulation.step=0.004", "simulation.precision=float64"]


@pytest.fixture(scope="module")
def made(comm, shared_folder):
    """A folder with the scene, its ground truth and an untrained kernel."""
    folder = shared_folder()
    scene = prepared(comm, folder, model="", start=0, turnovers=0.3, side=8, overrides=SCENE,
                     removals=["training", "tracers.field_cells"])
    first_rank(comm, (folder / "baseline.toml").write_text, scene.to_toml())
    return folder


@pytest.fixture
def folder(made, linked):
    """A new run directory with links to these."""
    return linked(made)


def simulate(comm, folder, *overrides):
    stage.run(load_scene(folder / "baseline.toml", overrides), comm, folder)


def read(folder):
    """Attributes, times, and columns (frames, particles, ...) of model and truth by name, on rank 0."""
    with open_rollout(folder, MPI.COMM_SELF) as measured:
        runs = measured.particles
        columns = {name: {column: np.array([run.read(frame, column) for frame in range(len(run.times))])
                          for column in run.columns} for name, run in runs.items()}
        assert measured.rollout.outside_training is None  # a matter of networks
        return measured.rollout.attributes, runs["model"].times, columns


def energy(columns):
    return 0.5 * (columns["velocity"] ** 2).sum(axis=(1, 2)) / columns["velocity"].shape[1]


@pytest.mark.mpi(1)
def test_an_untrained_model_of_smoothed_particles_keeps_momentum_and_integrates_its_density(comm, folder):
    train.run(load_scene(folder / "baseline.toml", SMOOTHED), comm, folder)
    weights = load_weights(comm, folder / "model.h5", "model").weights
    assert sorted(map(float, weights.values())) == [1, 1, 2]  # c in units of the fluid's, alpha, beta
    simulate(comm, folder, *SMOOTHED, "simulation.turnovers=0.04")
    attributes, _, columns = read(folder)
    model = columns["model"]
    assert attributes["status"] == "complete"
    assert moved_by(attributes) == "the model, terms continuity, wcsph"
    momentum = model["velocity"].mean(axis=1)
    assert len(momentum) > 1 and np.abs(momentum - momentum[0]).max() < 1e-6
    # Random places disturb the density, which starts as the true one and is integrated.
    spread = model["density"].std(axis=1)
    assert spread[0] < 0.003 < spread[-1] < 0.03 and np.abs(model["density"].mean(axis=1) - 1).max() < 5e-3


def velocity_error(columns, frame):
    """Velocity error of all particles, relative to the truth."""
    model, truth = (columns[name]["velocity"][frame] for name in ("model", "truth"))
    return np.linalg.norm(model - truth) / np.linalg.norm(truth)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("fluid, error", [("compressible", 3e-6), ("incompressible", 3e-2)])
def test_a_grid_of_the_resolution_of_the_truth_is_the_truth(comm, folder, fluid, error):
    """Equations, precision and steps are the same, except that the state is stored in single precision. Without sound
    the difference is of the order of M_t^2."""
    simulate(comm, folder, "simulation.method=eulerian", "eulerian.cells=16", f"eulerian.fluid={fluid}",
             "simulation.precision=float64")
    attributes, times, columns = read(folder)
    assert attributes["status"] == "complete" and len(times) > 3
    assert velocity_error(columns, 0) < min(error, 1e-3) and velocity_error(columns, -1) < error
    assert ("density" in columns["model"]) == (fluid == "compressible")
    if fluid == "compressible":
        # Centred differences of the truth are of second order in the frame interval.
        difference = columns["model"]["acceleration"] - columns["truth"]["acceleration"]
        assert np.linalg.norm(difference) < 0.03 * np.linalg.norm(columns["truth"]["acceleration"])
        density = columns["truth"]["density"]
        assert np.abs(columns["model"]["density"] - density).max() < 1e-3 * np.abs(density - 1).max()


@pytest.mark.mpi(2)
@pytest.mark.parametrize("equations, closure", [("unfiltered", "dynamic-smagorinsky"), ("filtered", "dynamic-mixed")])
def test_particles_follow_the_coarse_flow(comm, folder, equations, closure):
    form = [*COARSE, f"eulerian.equations={equations}", f"eulerian.closure={closure}"]
    simulate(comm, folder, *form)
    if comm.rank == 0:
        attributes, times, columns = read(folder)
        model = columns["model"]
        assert attributes["status"] == "complete"
        assert moved_by(attributes).endswith(
            f"on 12³ cells, |kᵢ| ≤ 3, incompressible, {equations} velocity, closure: {closure}, started from the flow")
        # It resolves |k| <= 3 of a flow that has most of its energy there.
        assert 0 < velocity_error(columns, 0) < 0.2 and velocity_error(columns, -1) < 0.35
        # The acceleration is the rate of change of the velocity along the way: centred differences are of second order.
        change = (model["velocity"][2:] - model["velocity"][:-2]) / (times[2:] - times[:-2])[:, None, None]
        difference = np.linalg.norm(change - model["acceleration"][1:-1]) / np.linalg.norm(change)
        assert difference < 0.05
        simulate(MPI.COMM_SELF, folder, *form)
        alone = read(folder)[2]["model"]
        # Computed and stored in single precision.
        assert np.abs(alone["acceleration"] - model["acceleration"]).max() < 1e-4
        assert np.abs(alone["position"] - model["position"]).max() < 1e-5
    comm.Barrier()


@pytest.mark.mpi(2)
@pytest.mark.parametrize("equations", ["unfiltered", "filtered"])
def test_a_grid_starts_from_what_the_particles_tell(comm, folder, equations):
    """Also at a time at which the whole flow is not stored, from which the true modes cannot be taken."""
    form = ["simulation.method=eulerian", "eulerian.cells=16", "simulation.precision=float64", "simulation.start=0.3",
            "simulation.turnovers=0.04", f"eulerian.equations={equations}"]
    with pytest.raises(SceneError, match="starts at 0.231 of the .*, which holds the unfiltered flow only at 0.0769;"):
        simulate(comm, folder, *form)
    simulate(comm, folder, *form, "eulerian.start=particles")
    if comm.rank == 0:
        attributes, _, columns = read(folder)
        assert moved_by(attributes).endswith("started from the particles")
        # What 512 particles determine of a flow with |k| <= 5.
        assert 1e-3 < velocity_error(columns, 0) < 0.05 and velocity_error(columns, -1) < 0.08
        simulate(MPI.COMM_SELF, folder, *form, "eulerian.start=particles")
        alone = read(folder)[2]["model"]
        # The solve ends at a residual of 2e-4 of the velocities.
        assert np.abs(alone["velocity"] - columns["model"]["velocity"]).max() < 2e-3
    comm.Barrier()


@pytest.mark.mpi(1)
def test_closures_dissipate_and_forcing_injects(comm, folder):
    ends = {}
    for name, more in {"none": [], "smagorinsky": ["eulerian.closure=smagorinsky"],
                       "spectral": ["eulerian.closure=spectral"], "forced": ["simulation.injection=1.0"],
                       "filtered": ["eulerian.equations=filtered"],
                       "gradient": ["eulerian.equations=filtered", "eulerian.closure=gradient"]}.items():
        simulate(comm, folder, *COARSE, *more)
        _, times, columns = read(folder)
        ends[name] = energy(columns["model"])[-1] / energy(columns["truth"])[-1]
        ends[name, "error"] = velocity_error(columns, -1)
    assert ends["smagorinsky"] < 0.99 * ends["none"] and ends["spectral"] < 0.999 * ends["none"]
    # All modes below |k| = 2 are resolved. The filter leaves exp(-k^2 d^2/12) of the power there, 0.54 to 0.81.
    power = (ends["forced"] - ends["none"]) * energy(columns["truth"])[-1]
    assert 0.5 * times[-1] < power < 0.85 * times[-1]
    # The gradient model recovers a part of the filtered stress.
    assert ends["gradient", "error"] < 0.9 * ends["filtered", "error"]


@pytest.mark.mpi(1)
def test_an_unstable_coarse_flow_ends_the_rollout(comm, folder, caplog):
    caplog.set_level(logging.INFO)
    simulate(comm, folder, *COARSE, "eulerian.closure=smagorinsky", "eulerian.smagorinsky=500")
    attributes, _, columns = read(folder)
    assert all(np.isfinite(value) for value in attributes.values() if not isinstance(value, str))
    assert "seconds_per_step" not in attributes and "too few steps to time" in caplog.text
    assert attributes["status"].startswith("stopped: step") and "coarse flow is unstable" in attributes["status"]
    assert len(columns["model"]["velocity"]) >= 1
