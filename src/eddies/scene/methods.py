"""What can move the particles of a rollout, by what it needs: the words of [simulation] method."""

from dataclasses import dataclass

from eddies.import_path import is_path, load
from eddies.scene.rules import quoted
from eddies.scene.values import SceneError

NEEDS = ("model", "density", "pairs")


@dataclass(frozen=True)
class Method:
    """What is known of a method without loading it.

    Parameters
    ----------
    needs : a trained "model"; the "density" of the ground truth; "pairs", neighbours within the radius of interaction.
        A class of the user's says so in its attribute `needs`.
    title : in tables and figures.
    on_grid : whether a flow on a coarse grid moves them, as [eulerian] says, in place of rates of their own.
    """

    needs: tuple[str, ...] = ()
    title: str = "own method"
    on_grid: bool = False


METHODS = {
    "learned": Method(needs=("model",), title="particle model"),
    "none": Method(title="no force"),
    "eulerian": Method(title="coarse grid", on_grid=True),
}


def method_of(name: str) -> Method:
    """That of a word or an import path; a class is loaded only where it is the user's.

    Raises SceneError where it needs what is none of NEEDS.
    """
    if not is_path(name):
        return METHODS[name]
    needs = getattr(load(name), "needs", ())
    if isinstance(needs, str) or not set(needs) <= set(NEEDS):
        raise SceneError(f"[simulation] method: {quoted(name)}: needs = {quoted(needs)}: must be a tuple of any of "
                         f"{', '.join(map(quoted, NEEDS))}")
    return Method(tuple(needs), title=name.rpartition(":")[2])
