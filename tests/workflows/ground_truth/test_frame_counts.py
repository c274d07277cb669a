"""The frames that stages use: each with the fields and neighbouring frames that it needs."""

from dataclasses import replace

import numpy as np
import pytest

from eddies.scene.scene import Horizons, SceneError, load_scene
from eddies.workflows.ground_truth.frame_counts import (check_frames, last_trained_on, rollout_start, trained_frames,
                                                        unfiltered_frames)
from tests.small_scene import TINY

FRAMES = 101


@pytest.mark.parametrize("changes", [[], ["simulation.start=0.31"], ["training.window=0.7"], ["simulation.start=0"]])
def test_the_whole_flow_is_stored_where_rollouts_start(changes):
    scene = load_scene("hit-small", changes)
    every = scene.tracers.field_every
    seen = scene.seen_in(scene.directory)
    start = rollout_start(scene.simulation, scene.tracers, seen, FRAMES, range(0, FRAMES, every))
    assert unfiltered_frames(scene.simulation, scene.training, every, FRAMES) == {every, start}
    assert unfiltered_frames(None, None, every, FRAMES) == set()


@pytest.mark.parametrize("window, horizons, held_out", [
    (0.8, None, 8), (0.8, Horizons(steps=100, frames=(1, 20)), 20), (0.15, None, 2)],
    ids=["a tenth", "the longest horizon", "at least two"])
def test_frames_that_validate_are_not_trained_on(window, horizons, held_out):
    training = replace(load_scene("hit-small").training, window=window, horizons=horizons)
    assert last_trained_on(training, FRAMES) == window * (FRAMES - 1) - held_out


def test_the_field_loss_uses_frames_with_a_field_one_frame_later():
    """The window is half of 101 frames, and 5 of its frames are for validation. Rates need a frame on both sides."""
    training = replace(load_scene("hit-small").training, window=0.5)
    assert trained_frames(training, FRAMES, range(0, FRAMES, 5)) == ([*range(1, 46)], 49)
    flow = replace(training, field_target="flow")
    assert trained_frames(flow, FRAMES, range(0, FRAMES, 5)) == ([*range(4, 45, 5)], 49)
    for every, which in ((60, "for training has one"), (30, "for validation has one")):
        scene = load_scene("hit-small", ["training.field_target=flow", "training.window=0.5",
                                         f"tracers.field_every={every}"])
        with pytest.raises(SceneError, match=f"field_target.*{which}; lower .tracers. field_every"):
            check_frames(["train"], scene, scene.training.window, FRAMES)


@pytest.mark.parametrize("frames, every", [
    (12, 6), (13, 6), *np.random.default_rng(5).integers((2, 1), (90, 12), (8, 2)).tolist()])
def test_a_rollout_starts_at_the_first_field_that_truth_follows(frames, every):
    tiny = load_scene(TINY)
    field_frames = range(0, frames, every)
    usable = [frame for frame in field_frames if frame >= max(int(0.5 * (frames - 1)), 1) and frame + 5 <= frames - 2]
    if usable:
        assert rollout_start(tiny.simulation, tiny.tracers, 0.5, frames, field_frames) == usable[0]
    else:
        with pytest.raises(SceneError, match="start: the rollout needs a frame"):
            rollout_start(tiny.simulation, tiny.tracers, 0.5, frames, field_frames)
