"""The step that is found for a rollout, compared with known errors, and its use by the rollout."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from eddies.io.hdf5 import open_product, read_attributes, read_table
from eddies.particles.flow_units import ReferenceScales
from eddies.scene.scene import Model, SceneError, load_scene
from eddies.workflows import find_step, simulate
from eddies.workflows.run_directory.fingerprints import stage_fingerprint
from tests.workflows.small_rollout import OWN_METHOD, prepared, with_method

# The error of the velocity is a constant plus a part of first order in the step.
FIRST_ORDER = OWN_METHOD + """

class FirstOrder(Swept):
    slope = SLOPE

    def __init__(self, scene, *rest):
        super().__init__(scene, *rest)
        self.longest = scene.simulation.step

    def advance(self, until, number):
        self.time += min(until - self.time, self.longest)

    def frame(self, time):
        velocity = self.particles.velocity + self.slope * self.longest
        return ParticleSet(self.particles.id, self.particles.position, velocity), torch.zeros_like(velocity)
"""


@pytest.fixture
def own_method(comm, own):
    """A function that writes the method with a slope, and returns its import path."""
    def write(slope):
        own("first_order", FIRST_ORDER.replace("SLOPE", str(slope)))
        return "first_order:FirstOrder"

    return write


def searched(scene, method="none", **keys):
    """The scene with a step that is to be found."""
    return with_method(scene, method, step="converged", integrator="rk2", **keys)


def sizes_and_errors(comm, scene, directory, turnovers, slope, sizes=None):
    """Steps of the ladder, and the relative error of each that FirstOrder has, with the rms fluctuation of the
    velocity."""
    with open_product(comm, directory / "ground_truth.h5", "ground_truth") as file:
        span = turnovers * read_attributes(file, "reference")["eddy_turnover_time"]
    frames = round(span / scene.tracers.frame_interval)
    first, last = velocities(comm, directory, scene.tracers.field_every, scene.tracers.field_every + frames)
    rms = np.sqrt(np.mean((last - last.mean(axis=0)) ** 2))
    sizes = span / 2.0 ** np.arange(20) if sizes is None else sizes
    return sizes, [np.sqrt(np.mean((first + slope * size - last) ** 2)) / rms for size in sizes], rms


def first_converged(sizes, errors, rms, slope):
    return next(size for size, error in zip(sizes, errors[1:]) if slope * size / 2 / rms < np.sqrt(1.02**2 - 1) * error)


def velocities(comm, directory, *frames):
    """True velocities of all particles at some frames, in double precision."""
    with open_product(comm, directory / "ground_truth.h5", "ground_truth") as file:
        value = file["particles/tracers/velocity/value"]
        return [value[frame].astype(np.float64) for frame in frames]


def found_step(comm, scene, directory):
    find_step.run(scene, comm, directory)
    with open_product(comm, directory / "step.h5", "step") as file:
        return read_attributes(file, "found"), read_table(file, "trials/rk2")


@pytest.mark.mpi(1)
def test_the_step_is_the_longest_whose_half_changes_little_of_the_error(comm, small_products, linked, own_method):
    """The error of the method is a + b h, so that halving the step changes b h / 2. In a weaker flow the same error is
    a larger share, and the step must converge there too."""
    directory = linked(small_products[1])
    scene, weaker = searched(small_products[0], own_method(3.0)), directory / "weaker"
    prepared(comm, weaker, overrides=["initial.amplitude=0.2"])
    found, trials = found_step(comm, scene, directory)
    sizes, errors, rms = sizes_and_errors(comm, scene, directory, found["turnovers"], 3.0)
    assert found["size"] == pytest.approx(first_converged(sizes, errors, rms, 3.0)) and found["integrator"] == "rk2"
    assert found["confirmed_on"] == 0
    assert {"seconds_per_step", "surplus_load", "switches_per_step"} <= found.keys()
    assert trials["size"] == pytest.approx(sizes[:len(trials["size"])])
    assert trials["error"] == pytest.approx(errors[:len(trials["size"])], rel=1e-6)
    assert trials["difference"][1:] == pytest.approx(3.0 * trials["size"][1:] / rms, rel=1e-5)

    both = replace(scene, simulation=replace(scene.simulation, confirmed_on=(str(weaker),)))
    assert stage_fingerprint(both, "find-step") != stage_fingerprint(scene, "find-step")
    confirmed, _ = found_step(comm, both, directory)
    least = first_converged(*sizes_and_errors(comm, scene, weaker, found["turnovers"], 3.0, sizes), 3.0)
    assert confirmed["size"] == pytest.approx(least) and least < found["size"] and confirmed["confirmed_on"] == 1


def ladder(comm, integrator, evaluations, seconds, error):
    """Rollouts whose velocity is off by 0.3 + error(h) in units of its rms, so that ends within 0.06 have converged."""
    stretch = object.__new__(find_step.Stretch)
    stretch.truth = SimpleNamespace(decomposition=SimpleNamespace(comm=comm))
    stretch.end = np.repeat([[1.0], [-1.0]], 2, axis=0) * np.ones(3)

    def tried(stretch, step):
        return find_step.Trial(stretch, step, seconds / step.size, stretch.end + 0.3 + error(step.size))

    return find_step.Ladder(tried, [stretch], integrator, 0.32, evaluations)


@pytest.mark.mpi(1)
def test_other_integrators_are_tried_where_they_may_be_cheaper(comm):
    """The first-order scheme converges up to h = 0.01, the fourth-order one up to 0.08 at less cost. The third is given
    up at once."""
    ladders = [ladder(comm, "first", 1, 1, lambda h: 10 * h), ladder(comm, "worse", 2, 2, lambda h: 30 * h),
               ladder(comm, "fourth", 4, 4, lambda h: 200 * h**4)]
    found, rung = find_step.cheapest(ladders)
    tried = {ladder.integrator: [trial.step.size for trial in ladder.trials.values()] for ladder in ladders}
    assert tried == {"first": pytest.approx([0.32 / 2**rung for rung in range(7)]), "worse": [0.02],
                     "fourth": [0.04, 0.08, 0.16]}
    assert found.integrator == "fourth" and found[rung].step.size == 0.08
    assert found.difference(rung + 1) == pytest.approx(200 * (0.08**4 - 0.04**4))
    assert np.isnan(found.difference(rung - 1)) and found.table()["size"] == [0.16, 0.08, 0.04]


@pytest.mark.mpi(1)
def test_an_integrator_of_cheap_evaluations_is_tried_with_shorter_steps(comm):
    """The second converges at 0.01, which needs twice the evaluations of the first at 0.01 in half of the time."""
    found, rung = find_step.cheapest([ladder(comm, "first", 1, 1.0, lambda h: 10 * h),
                                      ladder(comm, "cheap", 2, 0.4, lambda h: 9 * h)])
    assert found.integrator == "cheap" and found[rung].step.size == 0.01


def test_steps_that_a_rollout_would_shorten_are_not_tried():
    """Else a step and its half would be the same rollout, and pass for converged."""
    scene = with_method(load_scene("hit-coarse").variant["paper"], "learned", frame_interval=1.0, step="converged")
    scales = ReferenceScales(velocity=1.0, acceleration=1.0, filter_width=1.0, spacing=0.5, density_mean=1.0,
                             viscosity=0.01)
    local = replace(scene, model=Model(preset="local"))
    first = {name: size for name, size, _ in find_step.integrators(local, scales, 2.0)}
    assert first["rk3"] == first["rk2"] == 0.125 and first["verlet"] == 0.0625  # at most 0.157, 0.125, 0.0625 d/u'
    free = replace(local, model=Model(preset="local", settings={"filtered-equations": {"relaxation": 0.0}}))
    for unlimited in (scene, free):
        assert {size for _, size, _ in find_step.integrators(unlimited, scales, 2.0)} == {1.0, 2.0}


@pytest.mark.mpi(2)
def test_a_rollout_takes_the_step_that_was_found(comm, small_products, linked, unmeasured):
    """Without a force any step is exact, so the first is taken: the whole of the short rollout."""
    scene, directory = searched(small_products[0]), linked(small_products[1])
    find_step.run(scene, comm, directory)
    simulate.run(scene, comm, directory)
    with open_product(comm, directory / "step.h5", "step") as file:
        found = read_attributes(file, "found")
    with open_product(comm, directory / "rollout.h5", "rollout") as file:
        rollout = read_attributes(file, "rollout")
    assert found["difference"] < 1e-12 and found["size"] >= scene.simulation.frame_interval
    assert rollout["time_step"] == pytest.approx(found["size"])


@pytest.mark.mpi(1)
def test_without_a_converged_step_or_with_other_particles_there_is_no_step(comm, small_products, linked, own_method):
    directory = linked(small_products[1])
    with pytest.raises(SceneError, match='step = "converged": no step down to'):
        find_step.run(searched(small_products[0], own_method(1e9)), comm, directory)
    prepared(comm, directory / "more", side=7)
    with pytest.raises(SceneError, match="confirmed_on: .*ground_truth.h5 holds 343 particles, not 216"):
        find_step.run(searched(small_products[0], confirmed_on=(str(directory / "more"),)), comm, directory)
    interval = 1000 * small_products[0].tracers.frame_interval
    with pytest.raises(SceneError, match="the search for the step needs one such interval"):
        find_step.run(searched(small_products[0], frame_interval=interval), comm, directory)
    assert not (directory / "step.h5").exists()
