"""What moves the particles of a rollout: models in the units of its start frame, with and without a density, and a
class of the user's."""

import json
import logging
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import torch

from eddies.io.hdf5 import open_product, read_attributes, read_table
from eddies.io.trajectories import Trajectory
from eddies.io.weights import save_weights
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.flow_units import resolved_wavenumber
from eddies.particles.integrators import INTEGRATORS, RungeKutta
from eddies.particles.resolved_velocity import ResolvedVelocity
from eddies.particles.smoothing_kernels import KernelNetwork
from eddies.scene.integrators import SCHEMES
from eddies.scene.scene import BOX_LENGTH, Model, SceneError, load_scene
from eddies.workflows import dns, report, simulate, train
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.learned.model import scene_model
from eddies.workflows.learned.source import describe
from eddies.workflows.rollout.particle_run import SOLVES, LearnedRun
from eddies.workflows.rollout.method_of_step import METHODS, method_of_step
from eddies.workflows.run_directory.fingerprints import stage_provenance

pytestmark = pytest.mark.usefixtures("quick_spectra")

SCENE = """
[flow]
fluid = "{fluid}"
cells = 12
viscosity = 0.1
{sound}
[tracers]
particles_per_side = {side}
turnovers = {turnovers}
frame_interval = 0.02
field_every = 1
field_cells = 8
[kernel]
neighbors = 20
steps = 1
{model}
[training]
window = 1
frames = 2
batch = 60
steps = 4
combined_steps = 2
field_weight = 0.1
[training.horizons]
steps = 1
frames = [1]
[simulation]
step = 0.02
turnovers = 0.05
frame_interval = 0.04
start = {start}
"""
MODEL = '[model]\npreset = "resolved + pairs"\n[model.pairs]\ninputs = ["density", "distance", "speed", "approach"]'
WITHOUT_DENSITY = {
    "resolved": '[model]\nterms = ["pressure", "stress", "damping", "relaxation"]',
    "pairs": '[model]\npreset = "resolved + pairs"\n[model.pairs]\nhidden = [4]',
}
OWN_METHOD = """
import torch

from eddies.particles.particle_set import ParticleSet
from eddies.workflows.run_directory.fingerprints import stage_provenance


class Swept:
    '''All particles drift with the same wind.'''

    needs = ()
    has_density = False

    def __init__(self, scene, truth, start, directory, device):
        self.time = 0.0
        self.length, self.wind = truth.decomposition.length, torch.tensor([0.5, 0.0, -1.0], dtype=torch.float64)
        columns = truth.particles(start)
        columns.pop("density", None)
        self.particles = ParticleSet.from_numpy(columns)

    def advance(self, until, number):
        step = min(until - self.time, 0.03)
        moved = (self.particles.position + step * self.wind) % self.length
        velocity = self.wind.expand_as(moved).contiguous()
        self.particles = ParticleSet(self.particles.id, moved, velocity)
        self.time += step

    def frame(self, time):
        assert abs(time - self.time) < 1e-12
        return self.particles, torch.zeros_like(self.particles.velocity)

    def status(self):
        return "  the wind blows"

    def series(self):
        return {"wind": {"strength": []}}

    def description(self):
        return {"integrator": "exact", "terms": "wind"}
"""


def prepared(comm, directory, fluid="compressible", model=MODEL, start=0.3, turnovers=0.14, side=6, overrides=()):
    """The scene, with its ground truth in a directory, and a kernel with the weights that training starts from."""
    path = directory / "own.toml"
    if comm.rank == 0:
        directory.mkdir(parents=True, exist_ok=True)
        sound = "sound_speed = 15.0" if fluid == "compressible" else ""
        path.write_text(SCENE.format(fluid=fluid, sound=sound, model=model, start=start, turnovers=turnovers,
                                     side=side))
    comm.Barrier()
    scene = load_scene(path, overrides)
    dns.run(scene, comm, directory)
    network = KernelNetwork(scene.kernel_support, [4])
    description = {"form": network.formula, "support": network.support, "hidden": [4], "cutoff": "smooth"}
    weights = {name: tensor.numpy() for name, tensor in network.state_dict().items()}
    save_weights(comm, directory / "kernel.h5", "kernel", description, weights,
                 stage_provenance(scene, "train-kernel"), {"history": {"step": np.zeros(1)}})
    return scene


def write_model(comm, directory, scene, scales, bound=1e3, features=5):
    """The model as training begins with it, all of whose inputs were seen up to a bound."""
    weights = {name: tensor.float().numpy() for name, tensor in scene_model(scene, scales, comm).state_dict().items()}
    ranges = {"low": np.full(features, -bound), "high": np.full(features, bound)}
    save_weights(comm, directory / "model.h5", "model", describe(scene, scales), weights, {}, {"feature_range": ranges})


def method_of(comm, directory, scene, start):
    with open_product(comm, directory / "ground_truth.h5", "ground_truth") as file:
        truth = GroundTruth(file, SlabDecomposition(comm, BOX_LENGTH, scene.tracers.planes))
        method = method_of_step(scene, None, truth, start, directory, torch.device("cpu"))
        with torch.no_grad():
            return truth.scales, method, *method.frame(0.0)


@pytest.mark.usefixtures("quick_solves")
@pytest.mark.mpi(1, 2)
def test_units_are_those_of_the_release_whatever_follows(comm, tmp_path):
    """A flow that is followed twice as long gives the same rollout, bit for bit."""
    found = []
    for name, turnovers in (("short", 0.1), ("long", 0.2)):
        folder, start = tmp_path / name, 3
        scene = prepared(comm, folder, turnovers=turnovers)
        release, *_ = method_of(comm, folder, with_method(scene, "none"), start)
        write_model(comm, folder, scene, release)
        release, method, particles, acceleration = method_of(comm, folder, scene, start)
        assert method.flow.scales == method.model.flow.scales == release
        found.append((release, particles, acceleration))
    (scales, particles, acceleration), (other, more, again) = found
    assert scales == other and acceleration.abs().max() > 0
    assert torch.equal(particles.id, more.id) and torch.equal(particles.density, more.density)
    assert torch.equal(acceleration, again)


def with_method(scene, method, **keys):
    return replace(scene, simulation=replace(scene.simulation, method=method, **keys))


@pytest.mark.usefixtures("quick_solves")
@pytest.mark.mpi(1)
@pytest.mark.parametrize("method", METHODS)
def test_every_method_has_the_units_of_the_release_and_runs(comm, tmp_path, method):
    scene = with_method(prepared(comm, tmp_path, start=0.5), method)
    with open_product(comm, tmp_path / "ground_truth.h5", "ground_truth") as file:
        release = GroundTruth(file, SlabDecomposition(comm, BOX_LENGTH, 6)).scales
    write_model(comm, tmp_path, scene, release)
    scales, made, particles, acceleration = method_of(comm, tmp_path, scene, 3)
    assert getattr(made, "scales", scales) == scales
    assert (particles.density is not None) == made.has_density == (method == "learned")
    assert len(acceleration) == 6**3 and bool(torch.isfinite(acceleration).all())
    assert bool(acceleration.any()) == (method != "none")
    simulate.run(scene, comm, tmp_path)
    with open_product(comm, tmp_path / "rollout.h5", "rollout") as file:
        attributes = read_attributes(file, "rollout")
        assert attributes["status"] == "complete" and attributes["method"] == method
        assert ("density" in Trajectory(file, "model").columns) == (method == "learned")
    terms = {"learned": ", ".join(scene.model.terms), "none": "none"}
    assert attributes.get("terms") == terms.get(method)


@pytest.mark.mpi(2)
def test_particles_on_a_coarse_grid_may_move_as_far_as_the_courant_number(comm, tmp_path):
    scene = with_method(prepared(comm, tmp_path), "eulerian")
    scene = replace(scene, time=replace(scene.time, courant=1.9))
    _, method, *_ = method_of(comm, tmp_path, scene, 1)  # where the whole flow is stored
    spline, slab = method.tracers.field.spline, method.tracers.decomposition
    for planes in (-1.9, slab.count + 0.9):
        place = (slab.start + planes) * slab.spacing % BOX_LENGTH
        spline.around(np.array([[0.1, 0.2, place]]))


def untrained(comm, directory, side=6):
    """A scene with all products that a rollout needs, and half of the model's inputs outside of what it has seen."""
    scene = prepared(comm, directory, side=side)
    with open_product(comm, directory / "ground_truth.h5", "ground_truth") as file:
        scales = GroundTruth(file, SlabDecomposition(comm, BOX_LENGTH, side)).scales
    write_model(comm, directory, scene, scales, 0.5)
    return scene


def reported(comm, directory, untrained=("kernel.h5",)):
    """The numbers and the page of the report; of what is untrained there is nothing to show."""
    comm.Barrier()
    if comm.rank == 0:
        for name in untrained:
            (directory / name).unlink()
    comm.Barrier()
    report.run(directory, comm)
    comm.Barrier()
    page = (directory / "report" / "index.html").read_text(encoding="utf-8")
    return json.loads((directory / "report" / "metrics.json").read_text()), page


@pytest.mark.usefixtures("quick_solves")
@pytest.mark.mpi(2, 3)
def test_the_rollout_is_the_same_on_any_number_of_ranks(comm, tmp_path):
    """With frames between steps and on them."""
    from mpi4py import MPI

    scene = with_method(untrained(comm, tmp_path, side=9), "learned", precision="float64", turnovers=0.1, step=0.03)
    found = []
    for communicator in (comm, MPI.COMM_SELF):
        if communicator is comm or comm.rank == 0:
            simulate.run(scene, communicator, tmp_path)
            with open_product(communicator, tmp_path / "rollout.h5", "rollout") as file:
                found.append((Trajectory(file, "model").read(-1, "position"), read_table(file, "outside_training")))
        comm.Barrier()
    if comm.rank == 0:
        (positions, shares), (alone, shares_alone) = found
        assert np.abs(positions - alone).max() < 2e-6  # stored in single precision
        assert np.array_equal(shares["share"], shares_alone["share"]) and shares["share"].max() > 0


def rolled_out(comm, directory, scene, **keys):
    """Attributes of a rollout, what the closure's solves took, and the columns of its frames by name."""
    simulate.run(with_method(scene, **{"method": "learned", "turnovers": 0.14, **keys}), comm, directory)
    with open_product(comm, directory / "rollout.h5", "rollout") as file:
        run = Trajectory(file, "model")
        columns = {name: np.array([run.read(frame, name) for frame in range(len(run.times))])
                   for name in ("position", "velocity", "acceleration")}
        closure = read_table(file, "closure") if "closure" in file else None
        return read_attributes(file, "rollout"), closure, {"time": run.times, **columns}


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("step", [0.03, 0.1])
def test_frames_between_steps_lie_on_the_way(comm, tmp_path, step):
    """That of particles which keep their velocity is known."""
    attributes, closure, columns = rolled_out(comm, tmp_path, untrained(comm, tmp_path), method="none", step=step)
    count = len(columns["time"]) - 1
    assert closure is None and np.allclose(columns["time"], 0.04 * np.arange(count + 1)) and count == 3
    assert attributes["steps"] == -(-0.12 // step) and attributes["time_step"] == pytest.approx(step)
    straight = columns["position"][0] + columns["time"][:, None, None] * columns["velocity"][0]
    miss = columns["position"] - straight
    # Stored in single precision.
    assert np.abs(miss - BOX_LENGTH * np.rint(miss / BOX_LENGTH)).max() < 2e-6
    assert np.abs(columns["velocity"] - columns["velocity"][0]).max() < 1e-6 and not columns["acceleration"].any()


@pytest.mark.mpi(1)
def test_frames_of_long_steps_are_those_of_short_ones(comm, tmp_path, monkeypatch):
    for name in ("tolerance", "tolerance_foreseen"):
        monkeypatch.setattr(ResolvedVelocity, name, 1e-8)
    scene, found = untrained(comm, tmp_path), {}
    for step in (0.01, 0.03, 0.1):
        attributes, closure, found[step] = rolled_out(comm, tmp_path, scene, step=step, precision="float64")
        # Three stages, and the end of the last step; frames between are none of its evaluations.
        assert attributes["evaluations"] == 3 * attributes["steps"] + 1 and attributes["status"] == "complete"
        reached = np.ceil(np.arange(4) * 0.04 / step - 1e-9)
        between = [abs(time / step - round(time / step)) > 1e-9 for time in 0.04 * np.arange(4)]
        assert np.array_equal(closure["solves"], [1, *3 * np.diff(reached)] + np.array(between))
        assert (closure["most_iterations"] <= closure["iterations"]).all() and closure["residual"].max() < 1e-8
        assert not closure["not_converged"].any()
    short = found[0.01]
    for step in (0.03, 0.1):
        for name in ("velocity", "acceleration"):
            change = np.linalg.norm(short[name] - short[name][0])
            # Of third order, as the scheme is.
            assert np.linalg.norm(found[step][name] - short[name]) < 2e-3 * (step / 0.1) ** 3 * change


@pytest.mark.mpi(1, 2)
def test_steps_are_as_short_as_the_resolved_velocity_needs(comm, tmp_path, monkeypatch):
    """Of 0.05 radians of the highest wave by the rms velocity, which changes little."""
    monkeypatch.setitem(INTEGRATORS, "rk3", partial(RungeKutta, scheme=replace(SCHEMES["rk3"], angle=0.05)))
    scene = untrained(comm, tmp_path)
    attributes, closure, columns = rolled_out(comm, tmp_path, scene, step=0.5)
    with open_product(comm, tmp_path / "ground_truth.h5", "ground_truth") as file:
        scales = GroundTruth(file, SlabDecomposition(comm, BOX_LENGTH, scene.tracers.planes)).scales
    highest = int(resolved_wavenumber(scales.spacing, scales.filter_width, scales.kolmogorov_length))
    assert attributes["status"] == "complete" and attributes["steps"] > 2
    assert attributes["time_step"] * highest * columns["velocity"][0].std() == pytest.approx(0.05, rel=0.2)


@pytest.mark.usefixtures("no_figures", "quick_solves")
@pytest.mark.mpi(2)
def test_a_rollout_that_goes_wrong_ends_there_and_keeps_its_frames(comm, tmp_path):
    simulate.run(with_method(untrained(comm, tmp_path), "learned", injection=1e6), comm, tmp_path)
    with open_product(comm, tmp_path / "rollout.h5", "rollout") as file:
        status = read_attributes(file, "rollout")["status"]
        assert status.startswith("stopped: step") and "nearest particle" in status
        assert len(Trajectory(file, "model").times) >= 1
    assert "stopped: step" in reported(comm, tmp_path, ("kernel.h5", "model.h5"))[1]


@pytest.mark.usefixtures("no_figures", "quick_solves")
@pytest.mark.mpi(2)
@pytest.mark.parametrize("model, weights, rate", [
    ('preset = "paper"\n[model.pairs]\nhidden = [4]\n[model.density-flux]\nhidden = [4]', 4 + 4 + 2, True),
    ('terms = ["pressure", "viscosity"]', 0, False),
])
def test_other_models_run(comm, tmp_path, model, weights, rate):
    """Of two networks; of the resolved velocity alone, where nothing reads a density and there is nothing to learn."""
    scene = prepared(comm, tmp_path, model=f"[model]\n{model}")
    train.run(scene, comm, tmp_path)
    # Frames between steps too, with the density that is integrated.
    simulate.run(with_method(scene, "learned", step=0.03), comm, tmp_path)
    metrics, _ = reported(comm, tmp_path)
    assert (metrics["model"]["density_rate_error"] is not None) == rate and metrics["rollout"]["stable"]
    terms = scene.model.terms
    assert metrics["rollout"]["method"] == f"the model, terms {', '.join(terms)}"
    with open_product(comm, tmp_path / "model.h5", "model") as file:
        assert len(file["weights"]) == weights and ("feature_range" in file) == ("pairs" in terms)
        assert list(json.loads(file.attrs["description"])["terms"]) == list(terms)


@pytest.mark.usefixtures("no_figures", "quick_solves")
@pytest.mark.mpi(2)
@pytest.mark.parametrize("kind", WITHOUT_DENSITY)
def test_where_no_term_reads_the_density_an_incompressible_truth_will_do(comm, tmp_path, kind):
    scene = prepared(comm, tmp_path, "incompressible", WITHOUT_DENSITY[kind])
    assert "density" not in scene.model.reads
    train.run(scene, comm, tmp_path)
    simulate.run(scene, comm, tmp_path)
    with open_product(comm, tmp_path / "model.h5", "model") as file:
        errors = read_table(file, "a_priori")
        assert set(errors) == {"delay", "acceleration_error"} and np.isfinite(errors["acceleration_error"]).all()
        assert ("feature_range" in file) == (kind == "pairs") and "density_rate_sample" not in file
    with open_product(comm, tmp_path / "rollout.h5", "rollout") as file:
        assert read_attributes(file, "rollout")["status"] == "complete"
        assert set(Trajectory(file, "model").columns) == {"position", "image", "velocity", "acceleration"}
        assert ("outside_training" in file) == (kind == "pairs")
    assert f"terms {', '.join(scene.model.terms)}" in reported(comm, tmp_path)[1]


def test_terms_that_read_the_density_are_refused_there(tmp_path):
    path = tmp_path / "own.toml"
    path.write_text(SCENE.format(fluid="incompressible", sound="", turnovers=0.1, start=0, side=6,
                                 model='[model]\nterms = ["pressure", "pairs"]'))
    with pytest.raises(SceneError, match=r"\[model.pairs\]: reads the density, which an incompressible flow does"):
        load_scene(path)


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("fluid", ["compressible", "incompressible"])
def test_a_method_of_the_users(comm, tmp_path, own, fluid):
    if comm.rank == 0:
        own("own_method", OWN_METHOD)
    comm.Barrier()
    scene = replace(prepared(comm, tmp_path, fluid, WITHOUT_DENSITY["resolved"]), model=Model(preset="resolved"))
    simulate.run(with_method(scene, "own_method:Swept"), comm, tmp_path)
    if comm.rank == 0:
        with h5py.File(tmp_path / "rollout.h5") as file:
            attributes = dict(file["rollout"].attrs)
            assert attributes["method"] == "own_method:Swept" and attributes["terms"] == "wind"
            velocity = file["particles/model/velocity/value"]
            assert attributes["status"] == "complete" and len(velocity) > 1 and "wind" in file
            assert np.array_equal(velocity[-1], np.broadcast_to(np.float32([0.5, 0, -1]), velocity[-1].shape))
            assert "density" not in file["particles/model"]
    comm.Barrier()


@pytest.mark.mpi(1)
def test_solves_that_do_not_converge_are_told_once_and_all_counted(comm, monkeypatch, caplog):
    run = LearnedRun.__new__(LearnedRun)
    run.comm, run._solves = comm, {name: [] for name in SOLVES}
    with caplog.at_level(logging.INFO, logger="eddies"):
        for solves in ([(3, 1e-3, True)], [(3, 1e-3, True), (300, 0.02, False)], [(300, 0.04, False)]):
            run.dynamics = SimpleNamespace(resolution=SimpleNamespace(solves=solves))
            run._count_solves()
    (said,) = caplog.messages
    assert said.startswith("rollout: 1 of 2 solves for the resolved velocity did not converge in 300 iterations, the")
    assert run.series()["closure"]["not_converged"] == [0, 1, 1]
