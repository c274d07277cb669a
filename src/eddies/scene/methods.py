"""What can move the particles of a rollout: the words of [simulation] method."""

from eddies.import_path import is_path, load
from eddies.scene.rules import quoted
from eddies.scene.values import SceneError

NEEDS = ("model", "density", "pairs")

#: Of each word the class behind it, and what it needs: a trained "model"; the "density" of the ground truth; "pairs",
#: neighbours within the radius of interaction. A class of the user's says so in its attribute `needs`.
METHODS = {
    "learned": ("eddies.workflows.rollout.particle_run:LearnedRun", ("model",)),
    "none": ("eddies.workflows.rollout.particle_run:BallisticRun", ()),
    "eulerian": ("eddies.workflows.rollout.eulerian_run:EulerianRun", ()),
}


def method_class(method: str) -> type:
    """The class of a word or an import path, built as Class(scene, truth, start, directory, device)."""
    return load(method if is_path(method) else METHODS[method][0])


def needs_of(method: str) -> tuple[str, ...]:
    """What a method needs; its class is loaded only where it is the user's. SceneError where that is none of NEEDS."""
    if not is_path(method):
        return METHODS[method][1]
    needs = getattr(load(method), "needs", ())
    if isinstance(needs, str) or not set(needs) <= set(NEEDS):
        raise SceneError(f"[simulation] method: {quoted(method)}: needs = {quoted(needs)}: must be a tuple of any of "
                         f"{', '.join(map(quoted, NEEDS))}")
    return tuple(needs)
