"""Scenes that many tests start from."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from eddies.scene.scene import Scene, SceneError, load_scene

#: A scene of one model: the built-in `tiny` has variants.
TINY = str(Path(__file__).with_name("tiny.toml"))


def one_model(name: str, overrides: Sequence[str] = (), removals: Sequence[str] = ()) -> Scene:
    """A built-in scene without its variants, with the model `resolved` in place of the paper's, and changes of both."""
    return load_scene(name, ["model.preset=resolved", *overrides], ["variant", *removals])


def scene_file(folder: Path, text: str, name: str = "case.toml") -> Path:
    """A new file with the text of a scene."""
    path = folder / name
    path.write_text(text)
    return path


def scene_error(make: Callable[..., Any], *arguments: Any) -> str:
    """The text of the SceneError that a call raises."""
    with pytest.raises(SceneError) as error:
        make(*arguments)
    return str(error.value)


def problems_of(scene: Scene, comm) -> tuple[list[str], list[str]]:
    """Refusals and warnings of all stages of a scene."""
    from eddies.workflows.problems import problems
    from eddies.workflows.variants import steps
    return problems(scene, steps(scene, scene.stages_of_all, scene.directory), comm)
