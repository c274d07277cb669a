"""Scenes that many tests start from."""

from collections.abc import Sequence
from pathlib import Path

from eddies.scene.scene import Scene, load_scene

#: A scene of one model: the built-in `tiny` has variants.
TINY = str(Path(__file__).with_name("tiny.toml"))


def one_model(name: str, overrides: Sequence[str] = (), removals: Sequence[str] = ()) -> Scene:
    """A built-in scene without its variants, with the model `resolved` in place of the paper's, and changes of both."""
    return load_scene(name, ["model.preset=resolved", *overrides], ["variant", *removals])


def problems_of(scene: Scene, comm) -> tuple[list[str], list[str]]:
    """Refusals and warnings of all stages of a scene."""
    from eddies.workflows.problems import context_here, problems
    return problems(scene, context_here(scene.stages_of_all, scene.directory, comm))
