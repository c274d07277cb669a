from dataclasses import replace

import pytest

from eddies.scene.scene import Horizons, load_scene
from eddies.workflows.ground_truth.frame_counts import last_trained_on, rollout_start, whole_frames

FRAMES = 101


@pytest.mark.parametrize("changes", [[], ["simulation.start=0.31"], ["training.window=0.7"], ["simulation.start=0"]])
def test_the_whole_flow_is_stored_where_rollouts_start(changes):
    scene = load_scene("hit-small", changes)
    every = scene.tracers.field_every
    start = rollout_start(scene, scene.seen_in(scene.directory), FRAMES, range(0, FRAMES, every))
    assert whole_frames(scene, FRAMES) == {every, start}


def test_nowhere_without_a_rollout():
    assert whole_frames(load_scene("tracers-only"), FRAMES) == set()


@pytest.mark.parametrize("window, horizons, held_out", [
    (0.8, None, 8), (0.8, Horizons(steps=100, frames=(1, 20)), 20), (0.15, None, 2)],
    ids=["a tenth", "the longest horizon", "at least two"])
def test_what_validates_is_not_trained_on(window, horizons, held_out):
    training = replace(load_scene("hit-small").training, window=window, horizons=horizons)
    assert last_trained_on(training, FRAMES) == window * (FRAMES - 1) - held_out
