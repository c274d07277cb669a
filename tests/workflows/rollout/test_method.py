"""Rollouts of particles: units, frames, steps and ranks, models with and without a density, and a method of a user."""

import json
import logging
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from eddies.io.hdf5 import open_product, read_attributes, read_table
from eddies.io.trajectories import Trajectory
from eddies.parallel.stop import Stopped
from eddies.particles.exchanges import fluctuations, root_mean_square
from eddies.particles.flow_units import resolved_wavenumber
from eddies.particles.integrators import INTEGRATORS, RungeKutta
from eddies.particles.resolved_velocity import ResolvedVelocity
from eddies.scene.integrators import SCHEMES
from eddies.scene.scene import BOX_LENGTH, Model, SceneError, load_scene
from eddies.scene.sections import METHODS
from eddies.workflows import report, simulate, train
from eddies.workflows.diff import numbers_of
from eddies.workflows.ground_truth.truth import open_truth
from eddies.workflows.learned.model import initial_model
from eddies.workflows.learned.source import ModelDefinition
from eddies.workflows.rollout.method import SOLVES, ParticleRun, make_method
from tests.commands import first_rank
from tests.workflows.small_rollout import OWN_METHOD, prepared, scales_of, scene_text, with_method
from tests.workflows.stopping import StopAtStep

pytestmark = pytest.mark.usefixtures("unmeasured", "quick_spectra")


def method_of(comm, directory, scene, start):
    with open_truth(comm, directory / "ground_truth.h5") as truth:
        method = make_method(scene, None, truth, start, directory)
        with torch.no_grad():
            return method, *method.frame(0.0)


def read_rollout(comm, directory):
    """Attributes, tables, and columns (frames, particles, ...) with `time` of a rollout."""
    with open_product(comm, directory / "rollout.h5", "rollout") as file:
        run = Trajectory(file, "model")
        columns = {name: np.array([run.read(frame, name) for frame in range(len(run.times))]) for name in run.columns}
        tables = {name: read_table(file, name) for name in ("closure", "outside_training", "wind") if name in file}
        return read_attributes(file, "rollout"), tables, {"time": run.times, **columns}


def rolled_out(comm, directory, scene, **keys):
    simulate.run(with_method(scene, **{"method": "learned", "turnovers": 0.14, **keys}), comm, directory)
    return read_rollout(comm, directory)


@pytest.mark.usefixtures("quick_solves")
@pytest.mark.mpi(1)
@pytest.mark.parametrize("name", METHODS)
def test_every_method_runs_with_the_units_of_the_release(comm, small_products, linked, name):
    scene, directory = with_method(small_products[0], name), linked(small_products[1])
    method, particles, acceleration = method_of(comm, directory, scene, 1)  # a frame with the unfiltered flow
    assert name == "eulerian" or method.model.flow.scales == scales_of(comm, directory)
    assert (particles.density is not None) == method.has_density == (name == "learned")
    assert len(acceleration) == 6**3 and bool(torch.isfinite(acceleration).all())
    assert bool(acceleration.any()) == (name != "none")
    if name == "none":
        assert method.dynamics.neighborhood is None and method.dynamics.resolution is None
    simulate.run(scene, comm, directory)
    attributes, _, columns = read_rollout(comm, directory)
    assert attributes["status"] == "complete" and attributes["method"] == name
    assert ("density" in columns) == (name == "learned")
    assert attributes.get("terms") == {"learned": ", ".join(scene.model.terms), "none": "none"}.get(name)


@pytest.mark.mpi(2)
def test_particles_on_a_coarse_grid_may_move_as_far_as_the_courant_number(comm, small_products):
    scene = with_method(small_products[0], "eulerian")
    scene = replace(scene, time=replace(scene.time, courant=1.9))
    method, *_ = method_of(comm, small_products[1], scene, 1)  # a frame with the unfiltered flow
    spline, slab = method.tracers.field.spline, method.tracers.decomposition
    for planes in (-1.9, slab.count + 0.9):
        place = (slab.start + planes) * slab.spacing % BOX_LENGTH
        spline.around(np.array([[0.1, 0.2, place]]))


@pytest.mark.usefixtures("quick_solves")
@pytest.mark.mpi(2)
def test_the_rollout_is_the_same_on_any_number_of_ranks(comm, small_products, linked):
    """With frames between steps and at their ends."""
    from mpi4py import MPI

    scene, directory, found = small_products[0], linked(small_products[1]), []
    for communicator in (comm, MPI.COMM_SELF):
        if communicator is comm or comm.rank == 0:
            found.append(rolled_out(communicator, directory, scene, precision="float64", turnovers=0.1, step=0.03))
        comm.Barrier()
    if comm.rank == 0:
        (_, tables, columns), (_, tables_alone, alone) = found
        assert np.abs(columns["position"][-1] - alone["position"][-1]).max() < 2e-6  # stored in single precision
        share = tables["outside_training"]["share"]
        assert np.array_equal(share, tables_alone["outside_training"]["share"]) and share.max() > 0


@pytest.mark.mpi(1)
def test_frames_between_steps_of_free_particles_lie_on_straight_lines(comm, small_products, linked):
    scene, directory = small_products[0], linked(small_products[1])
    for step in (0.03, 0.1):
        attributes, tables, columns = rolled_out(comm, directory, scene, method="none", step=step)
        assert not tables and np.allclose(columns["time"], 0.04 * np.arange(4))
        assert attributes["steps"] == -(-0.12 // step) and attributes["time_step"] == pytest.approx(step)
        straight = columns["position"][0] + columns["time"][:, None, None] * columns["velocity"][0]
        miss = columns["position"] - straight
        # Stored in single precision.
        assert np.abs(miss - BOX_LENGTH * np.rint(miss / BOX_LENGTH)).max() < 2e-6
        assert np.abs(columns["velocity"] - columns["velocity"][0]).max() < 1e-6
        assert not columns["acceleration"].any()


@pytest.mark.mpi(1)
def test_frames_of_long_steps_are_those_of_short_ones(comm, small_products, linked, monkeypatch):
    tolerance = 1e-7
    for name in ("tolerance", "tolerance_predicted"):
        monkeypatch.setattr(ResolvedVelocity, name, tolerance)
    scene, directory, found = small_products[0], linked(small_products[1]), {}
    for step in (0.02, 0.03, 0.1):
        attributes, tables, found[step] = rolled_out(comm, directory, scene, step=step, precision="float64")
        # Three stages, and the end of the last step. Frames between steps are not counted.
        assert attributes["evaluations"] == 3 * attributes["steps"] + 1 and attributes["status"] == "complete"
        reached = np.ceil(np.arange(4) * 0.04 / step - 1e-9)
        between = [abs(time / step - round(time / step)) > 1e-9 for time in 0.04 * np.arange(4)]
        closure = tables["closure"]
        assert np.array_equal(closure["solves"], [1, *3 * np.diff(reached)] + np.array(between))
        assert (closure["most_iterations"] <= closure["iterations"]).all() and closure["residual"].max() < tolerance
        assert not closure["not_converged"].any()
    short = found[0.02]
    for step in (0.03, 0.1):
        for name in ("velocity", "acceleration"):
            change = np.linalg.norm(short[name] - short[name][0])
            # The scheme is of third order.
            assert np.linalg.norm(found[step][name] - short[name]) < 2e-3 * (step / 0.1) ** 3 * change


@pytest.mark.mpi(1)
def test_steps_are_as_short_as_the_resolved_velocity_needs(comm, small_products, linked, monkeypatch):
    """The rms velocity, which changes little, moves particles by 0.05 radians of the shortest wave."""
    monkeypatch.setitem(INTEGRATORS, "rk3", partial(RungeKutta, scheme=replace(SCHEMES["rk3"], angle=0.05)))
    directory = linked(small_products[1])
    attributes, _, columns = rolled_out(comm, directory, small_products[0], step=0.5)
    scales = scales_of(comm, directory)
    highest = int(resolved_wavenumber(scales.spacing, scales.filter_width, scales.kolmogorov_length))
    assert attributes["status"] == "complete" and attributes["steps"] > 2
    assert attributes["time_step"] * highest * columns["velocity"][0].std() == pytest.approx(0.05, rel=0.2)


@pytest.mark.mpi(2)
def test_steps_follow_the_present_flow_if_a_term_asks_for_it(comm, small_products):
    """In a flow with a quarter of the velocity the noise of single particles bears four times the step. The mean
    velocity has no effect."""
    scene, directory = small_products
    local = ModelDefinition.of(replace(scene, model=Model(preset="local")))
    with open_truth(comm, directory / "ground_truth.h5") as truth, torch.no_grad():
        for factor in (1.0, 0.25):
            run = ParticleRun(initial_model(local, truth.scales, comm), None,
                              replace(scene.simulation, step=10.0, integrator="rk3"), truth, 1, limited=False)
            velocity = factor * run.particles.velocity
            run.particles = replace(run.particles, velocity=velocity + velocity.new_tensor([0.0, 0.0, 1.0]))
            speed = root_mean_square(comm, fluctuations(comm, velocity))
            run.advance(50.0, 1)  # perhaps with a fault: the density is not that of such a flow
            assert run.time == pytest.approx(0.157 * truth.scales.filter_width / speed, rel=0.05)


def reported(comm, directory, *remove):
    """The numbers of the report, without untrained products, which have nothing to show."""
    comm.Barrier()
    for name in remove if comm.rank == 0 else ():
        (directory / name).unlink()
    comm.Barrier()
    report.run(directory, comm)
    comm.Barrier()
    return numbers_of(directory, None)


@pytest.mark.usefixtures("no_figures", "quick_solves")
@pytest.mark.mpi(2)
def test_a_rollout_that_goes_wrong_ends_there_and_keeps_its_frames(comm, small_products, linked):
    directory = linked(small_products[1])
    simulate.run(with_method(small_products[0], "learned", injection=1e6), comm, directory)
    attributes, _, columns = read_rollout(comm, directory)
    assert attributes["status"].startswith("stopped: step") and "nearest particle" in attributes["status"]
    assert len(columns["time"]) >= 1
    metrics = reported(comm, directory, "kernel.h5", "model.h5")
    assert not metrics["rollouts"]["stable"] and metrics["rollouts"]["status"] == attributes["status"]


@pytest.mark.usefixtures("no_figures", "quick_solves")
@pytest.mark.mpi(1)
@pytest.mark.parametrize("fluid, model, weights, removals", [
    ("compressible", '[model]\npreset = "paper"\n[model.pairs]\nhidden = [4]\n[model.density-flux]\nhidden = [4]', 10,
     []),
    ("compressible", '[model]\nterms = ["pressure", "viscosity"]', 0, []),
    ("incompressible", '[model]\npreset = "resolved + pairs"\n[model.pairs]\nhidden = [4]', None,
     ["kernel", "training.field_weight", "training.combined_steps"])],
    ids=["paper", "nothing to learn", "no density and no kernel"])
def test_models_are_trained_run_and_reported(comm, tmp_path, fluid, model, weights, removals):
    """The published system, a model without parameters, and a model of an incompressible flow without a density in a
    scene without [kernel]."""
    scene = prepared(comm, tmp_path, fluid, model, removals=removals)
    compressible = fluid == "compressible"
    assert ("train-kernel" in scene.stages) == (not removals)
    terms, learns_density = scene.model.terms, "density-flux" in scene.model.terms
    train.run(scene, comm, tmp_path)
    simulate.run(with_method(scene, "learned", step=0.03), comm, tmp_path)  # with frames between steps
    with open_product(comm, tmp_path / "model.h5", "model") as file:
        errors = read_table(file, "a_priori")
        assert weights is None or len(file["weights"]) == weights
        assert ("feature_range" in file) == ("pairs" in terms) and ("density_rate_sample" in file) == learns_density
        assert list(json.loads(file.attrs["description"])["terms"]) == list(terms)
    assert np.isfinite(errors["acceleration_error"]).all() and ("pressure_gradient_error" in errors) == compressible
    attributes, tables, columns = read_rollout(comm, tmp_path)
    assert attributes["status"] == "complete" and ("density" in columns) == learns_density
    assert ("outside_training" in tables) == ("pairs" in terms)
    metrics = reported(comm, tmp_path, *([] if removals else ["kernel.h5"]))
    assert metrics["rollouts"]["qr_kl"] is metrics["rollouts"]["qr_kl_floor"] is None
    assert metrics["rollouts"]["spectrum_error"] > 0
    assert (metrics["models"]["density_rate_error"] is not None) == learns_density and metrics["rollouts"]["stable"]
    assert metrics["rollouts"]["method"] == f"the model, terms {', '.join(terms)}"


def test_terms_that_read_the_density_are_refused_in_an_incompressible_flow(tmp_path):
    path = tmp_path / "own.toml"
    path.write_text(scene_text("incompressible", model='[model]\nterms = ["pressure", "pairs"]'))
    with pytest.raises(SceneError, match=r"\[model.pairs\]: reads the density"):
        load_scene(path)


@pytest.mark.mpi(2)
def test_a_method_of_the_users(comm, small_products, linked, own):
    """It has no state, so a stopped rollout begins again."""
    directory = linked(small_products[1])
    first_rank(comm, own, "own_method", OWN_METHOD)
    scene = with_method(replace(small_products[0], model=Model(preset="resolved")), "own_method:Swept")
    with pytest.raises(Stopped, match="after the last finished stage"):
        simulate.run(scene, comm, directory, StopAtStep(comm, 1))
    simulate.run(scene, comm, directory)
    assert not (directory / "checkpoints-rollout").exists()
    attributes, tables, columns = read_rollout(comm, directory)
    assert attributes["method"] == "own_method:Swept" and attributes["terms"] == "wind" and "wind" in tables
    assert attributes["status"] == "complete" and len(columns["time"]) > 1 and "density" not in columns
    assert np.array_equal(columns["velocity"][-1], np.broadcast_to(np.float32([0.5, 0, -1]), (216, 3)))


@pytest.mark.mpi(1)
def test_solves_that_do_not_converge_are_logged_once_and_all_counted(comm, caplog):
    run = ParticleRun.__new__(ParticleRun)
    run.comm, run.seen, run._solves = comm, None, {name: [] for name in SOLVES}
    with caplog.at_level(logging.INFO, logger="eddies"):
        for solves in ([(3, 1e-3, True)], [(3, 1e-3, True), (300, 0.02, False)], [(300, 0.04, False)]):
            run.dynamics = SimpleNamespace(resolution=SimpleNamespace(solves=solves))
            run._count_solves()
    (message,) = caplog.messages
    assert "1 of 2 solves" in message and "300 iterations" in message
    assert run.series()["closure"]["not_converged"] == [0, 1, 1]
