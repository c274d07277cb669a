"""The formula for wall times: it grows with the work, and falls with the ranks."""

import pytest

from eddies.scene.scene import load_scene
from eddies.workflows.foreseen.seconds import START, seconds
from tests.small_scene import one_model

STEP = "simulation.step=0.13"


@pytest.mark.parametrize("stage, override", [
    ("dns", "tracers.turnovers=9.6"), ("train-kernel", "kernel.steps=800"),
    ("train", "training.frames=64"), ("train", "training.steps=15000"), ("train", "training.horizons.steps=10"),
    ("train", "model.preset=resolved + pairs"), ("simulate", "simulation.step=0.01"),
    ("simulate", "simulation.turnovers=3"), ("report", "simulation.turnovers=3")])
def test_more_work_takes_longer_and_more_ranks_less(stage, override):
    once, more = one_model("hit-small", [STEP]), one_model("hit-small", [STEP, override])
    assert seconds(more, stage, 1) > 1.05 * seconds(once, stage, 1)
    assert START[stage] < seconds(more, stage, 2) < seconds(more, stage, 1)


def test_a_scene_that_takes_weights_is_tested_and_not_trained():
    taken = one_model("hit-small", ["model.path=somewhere"])
    assert START["train"] < seconds(taken, "train", 1) < 0.5 * seconds(one_model("hit-small"), "train", 1)


@pytest.mark.parametrize("method", ["none", "eulerian"])
def test_rollouts_without_a_model_have_a_time_too(method):
    assert 0 < seconds(one_model("hit-small", [f"simulation.method={method}"]), "simulate", 2) < 100


def test_the_paper_s_case_takes_most_of_a_day_on_256_ranks():
    """As steps of one rank's share of it on this machine say: docs/clusters.md."""
    assert 6 < seconds(load_scene("hit-paper"), "dns", 256) / 3600 < 50


def test_flows_of_unknown_speed_have_no_time(own):
    own("own_start", "def swirl(grid, initial, seed): pass\n")
    assert seconds(load_scene("taylor-green", ["initial.kind=own_start:swirl"]), "dns", 1) is not None  # a fixed step
    assert seconds(load_scene("hit-small", ["initial.kind=own_start:swirl", "flow.viscosity=0"]), "dns", 1) is None
