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


def test_nowhere_without_a_rollout():
    assert whole_frames(load_scene("tracers-only"), FRAMES) == set()
