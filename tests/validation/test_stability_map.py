"""Corners of the map of stability: rollouts of trained systems from extreme states end well, or with a cause."""

from functools import partial

import numpy as np
import pytest
from mpi4py import MPI
from stability_map import Flow, arrangements, outcome, rounded

from eddies.scene.model import WEIGHTS
from eddies.scene.scene import load_scene
from eddies.workflows import dns
from eddies.workflows.ground_truth.truth import open_truth

SYSTEMS = {"paper": "hit-small-paper", "local": "hit-local", "resolved": "hit-small"}
CAUSES = "density", "speed", "not finite"


USUAL = "flow.cells=16", "tracers.particles_per_side=8"
# Mach numbers of about 0.01 and 0.5; filters of 0.8 and 1.3 times the usual width.
EXTREME = {"slow": ("flow.sound_speed=200",), "fast": ("flow.sound_speed=4",),
           "narrow": ("tracers.particles_per_side=10",), "wide": ("tracers.particles_per_side=6", "training.batch=200")}


def flow_in(place, *changes):
    """The ground truth of a decaying flow of 16^3 cells with 8^3 particles, with changes."""
    scene = load_scene("tiny", [*USUAL, "tracers.turnovers=0.6", "spin_up.turnovers=0.2", "tracers.field_every=1",
                                "tracers.field_cells=12", *changes], ["variant"])
    dns.run(scene, MPI.COMM_SELF, place)
    return open_truth(MPI.COMM_SELF, place / "ground_truth.h5")


@pytest.fixture(scope="module")
def flow(tmp_path_factory):
    with flow_in(tmp_path_factory.mktemp("flow")) as truth:
        yield Flow(truth)


def scene_of(system):
    own = ["model.neighbors=60"] if system != "resolved" else []
    return load_scene("tiny", [f"model.preset={system}", *own], ["variant"])


def assert_ends_well_or_with_a_cause(found):
    assert found["cause"] in CAUSES if "broken" in found else np.isfinite([found["error"], found["energy"]]).all()


@pytest.mark.mpi(1)
@pytest.mark.parametrize("system", SYSTEMS)
def test_corners_of_the_map_end_well_or_with_a_cause(comm, system, flow, tmp_path):
    weights = WEIGHTS / f"{SYSTEMS[system]}.h5"
    scene = scene_of(system)
    usual = partial(outcome, scene, weights, flow)
    begin, expected = flow.start(), usual()
    assert np.isfinite(expected["error"])
    boosted = usual(frame=30 * flow.scales.velocity * np.array([0.6, -0.48, 0.64]))
    assert boosted["error"] == pytest.approx(expected["error"], rel=1e-2)  # solves end at 1e-3
    half = outcome(scene, rounded(weights, tmp_path / "half.h5"), flow)
    assert half["error"] == pytest.approx(expected["error"], rel=2e-2)  # weights of eleven bits
    corners = [partial(usual, flow.at(position)) for position in arrangements(flow).values()]
    corners += [partial(usual, begin | {"density": 1.1 * begin["density"]}), partial(usual, step=1.0)]
    for corner in corners:
        assert_ends_well_or_with_a_cause(corner())


@pytest.mark.mpi(1)
@pytest.mark.parametrize("flow_of", EXTREME)
def test_other_mach_numbers_and_filters_end_well_or_with_a_cause(comm, flow_of, tmp_path):
    with flow_in(tmp_path, *EXTREME[flow_of]) as truth:
        for system, weights in SYSTEMS.items():
            assert_ends_well_or_with_a_cause(outcome(scene_of(system), WEIGHTS / f"{weights}.h5", Flow(truth)))
