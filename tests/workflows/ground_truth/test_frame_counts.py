from dataclasses import replace

import pytest

from eddies.scene.scene import Horizons, SceneError, load_scene
from eddies.workflows.ground_truth.frame_counts import check_frames, last_trained_on, rollout_start, trained_frames
from eddies.workflows.ground_truth.frame_counts import whole_frames

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


def test_a_field_is_compared_with_where_one_is_stored_a_frame_later():
    """Of 101 frames half are the window, 5 of these held out; rates need a frame on both sides."""
    training = replace(load_scene("hit-small").training, window=0.5)
    assert trained_frames(training, FRAMES, range(0, FRAMES, 5)) == ([*range(1, 46)], 49)
    flow = replace(training, field_target="flow")
    assert trained_frames(flow, FRAMES, range(0, FRAMES, 5)) == ([*range(4, 45, 5)], 49)
    assert trained_frames(flow, FRAMES, range(0, FRAMES, 6)) == ([*range(5, 42, 6)], 47)


@pytest.mark.parametrize("every, which", [(60, "trained on"), (30, "held out")])
def test_a_field_too_seldom_is_refused(every, which):
    scene = load_scene("hit-small", ["training.field_target=flow", "training.window=0.5",
                                     f"tracers.field_every={every}"])
    with pytest.raises(SceneError, match=f"no filtered field is stored one frame after any that is {which}; lower"):
        check_frames(["train"], scene, scene.training.window, FRAMES)
