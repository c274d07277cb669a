import pytest

from eddies.scene.scene import load_scene
from eddies.workflows.ground_truth.frame_counts import rollout_start, whole_frames

FRAMES = 101


@pytest.mark.parametrize("changes", [[], ["simulation.start=0.31"], ["training.window=0.7"], ["simulation.start=0"]])
def test_the_whole_flow_is_stored_where_rollouts_start(changes):
    scene = load_scene("hit-small", changes)
    every = scene.tracers.field_every
    start = rollout_start(scene, scene.seen_in(scene.directory), FRAMES, range(0, FRAMES, every))
    assert whole_frames(scene, FRAMES) == {every, start}


@pytest.mark.parametrize("states, frames", [("[]", set()), ("[0]", {5}), ("[0.2, 0.501, 0.99]", {20, 50, 100})])
def test_or_where_a_scene_says(states, frames):
    assert whole_frames(load_scene("hit-small", [f"tracers.states={states}"]), FRAMES) == frames


def test_nowhere_without_a_rollout():
    assert whole_frames(load_scene("tracers-only"), FRAMES) == set()
