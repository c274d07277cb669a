"""The work that a run directory holds: products and checkpoints.

Work that fits the settings of the scene is kept or continued. Other work would be replaced.
"""

import json
import os
import tomllib
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from eddies.clock import duration
from eddies.errors import UserError
from eddies.io.checkpoint import checkpoints_in
from eddies.io.damage import open_to_read
from eddies.io.errors import ContentError, ProductError
from eddies.io.hdf5 import open_product, read_attributes, read_table
from eddies.io.provenance import product_fingerprint, product_provenance
from eddies.parallel.communicator import Comm
from eddies.pipeline import FILE_OF, STAGES, Stage
from eddies.scene.layers import dotted
from eddies.scene.rules import quoted
from eddies.scene.scene import Scene, Simulation
from eddies.scene.sections import CONVERGED
from eddies.workflows.run_directory.fingerprints import set_files, stage_fingerprint

SECONDS = "stage_seconds.json"
FAILURE = "failure.txt"  # the error of a failed variant
MOST_CHANGES = 3  # largest number of changed settings that a message names


class WouldReplaceWork(UserError):
    """A command would replace work that was made with other settings."""


class Action(NamedTuple):
    """What a run does with the work of a stage that it finds.

    start: "skip" the stage, "continue" from its checkpoint, or "begin" it. drops: whether the checkpoints are removed
    first. loses: the work that would be lost, of "product" and "checkpoints".
    """

    start: str
    drops: bool = False
    loses: tuple[str, ...] = ()


BEGIN, CONTINUE, SKIP = Action("begin"), Action("continue"), Action("skip")
LOSE_PRODUCT, LOSE_BOTH = Action("begin", False, ("product",)), Action("begin", True, ("product", "checkpoints"))
#: What a run does. Rows: the product that is found. Columns: no checkpoints; some of the same settings; only others.
#: "shorter" and "longer" have the same settings as the run but another duration. A damaged product is in row "other".
#: Checkpoints of the same settings may have another duration.
ACTIONS = {
    "none": (BEGIN, CONTINUE, Action("begin", True, ("checkpoints",))),
    # Checkpoints of a complete run are removed. Those of other settings may still be continued.
    "same": (Action("skip", True), Action("skip", True), SKIP),
    "shorter": (LOSE_PRODUCT, CONTINUE, LOSE_BOTH),
    # The checkpoint may lie after the end of the run.
    "longer": (LOSE_PRODUCT, Action("begin", True, ("product",)), LOSE_BOTH),
    "other": (LOSE_PRODUCT, Action("continue", False, ("product",)), LOSE_BOTH),
}


class Work(NamedTuple):
    """The work that stages find in a run directory: the action of each stage by its name, and the files that the stages
    would replace, each with its wall time or date."""

    actions: Mapping[str, Action]
    lost: Sequence[str]


def find_work(stages: Sequence[str], scene: Scene, directory: Path, links: Collection[str] = (),
              overwrite: bool = True) -> Work:
    """Find the work of a scene's stages that a run directory already holds; one rank calls it.

    `links` are further stages, whose products are links to other directories. Raises WouldReplaceWork if work would be
    replaced and `overwrite` is false. Raises ProductError if the system refuses to read a product or a checkpoint: such
    a file may be undamaged, and must not be replaced.
    """
    seconds, actions, lost = stage_seconds(directory), {}, {}
    changes: dict[str, None] = {}
    for stage in [STAGES[name] for name in (*links, *stages) if STAGES[name].product is not None]:
        actions[stage.name], of_stage = _work_of(stage, scene, directory, seconds.get(stage.name))
        lost |= of_stage
        for then in of_stage.values():
            changes |= dict.fromkeys(changed_settings(stage, then, scene.to_toml()))
    if lost and not overwrite:
        raise WouldReplaceWork(f"{directory}: holds work of {of_other_settings([*changes])} that would be replaced: "
                               f"{', '.join(lost)}; add --overwrite to replace it, or choose another --output")
    return Work(actions, [*lost])


def _work_of(stage: Stage, scene: Scene, directory: Path,
             seconds: float | None) -> tuple[Action, dict[str, str | None]]:
    """Return what a run does with the work of a stage, and the files that would be lost.

    The files are a dict from their names, with their cost, to the scene with which they were made, as text; None if it
    is unknown. `seconds` is the wall time of the stage.
    """
    origin = product_provenance(directory / stage.file)
    checkpoints = checkpoints_in(directory / stage.checkpoints) if stage.checkpoints else []
    fingerprints = [fingerprint for _, fingerprint in checkpoints]
    continued = stage_fingerprint(scene, stage.name, stage.duration)
    sets = _other_sets(scene, directory) if stage.name == "dns" else {}
    product = _product_state(stage, scene, directory / stage.file, origin, continued)
    if sets and product == "same":  # not all its parts are there
        product = "none"
    action = ACTIONS[product][0 if not checkpoints else 1 if continued in fingerprints else 2]
    if stage.name == "dns" and action.start == "skip":
        action = SKIP  # the last state serves a longer run
    lost = {f"{path}{_cost(other, None)}": other.get("scene") for path, other in sets.items()
            if (directory / path).is_file()}
    if "product" in action.loses:
        lost[stage.file + _cost(origin, seconds)] = origin.get("scene")
    if "checkpoints" in action.loses and origin.get("course") not in fingerprints:  # else the product's last state
        took = "" if seconds is None else f", took {duration(seconds)}"
        lost[f"{stage.checkpoints} (step {checkpoints[0][0]}{took})"] = _scene_of(directory)
    return action, lost


def _product_state(stage: Stage, scene: Scene, product: Path, origin: Mapping[str, Any], continued: str) -> str:
    """Return which row of ACTIONS holds for a product.

    `origin` is its provenance, empty if it cannot be read. `continued` is the fingerprint of the stage without its
    duration.
    """
    if origin.get("fingerprint") == stage_fingerprint(scene, stage.name):
        return "same"
    if not product.is_file() or product.is_symlink():  # a link is not work
        return "none"
    if not origin:
        _check_readable(product)
    if origin.get("course") == continued:
        return "longer" if origin["duration"] > scene.duration else "shorter"
    return "other"


def _other_sets(scene: Scene, directory: Path) -> dict[Path, dict[str, Any]]:
    """Return, by path, the provenance of each set's ground truth that is missing or has other settings."""
    origins = {path: (product_provenance(directory / path), wanted) for path, wanted in set_files(scene).items()}
    return {path: origin for path, (origin, wanted) in origins.items() if origin.get("fingerprint") != wanted}


def link_products(products: Mapping[Path, str], directory: Path) -> None:
    """Make a directory with relative links to products of other directories; one rank calls it.

    `products` maps the path of each product to the fingerprint of its settings. Products that do not exist get no link.
    If the directory holds a file with the name of a product, the file is kept if it has this fingerprint, and otherwise
    removed.
    """
    directory.mkdir(parents=True, exist_ok=True)
    for product, fingerprint in products.items():
        path = directory / product.name
        if path.is_symlink() or product_fingerprint(path) != fingerprint:
            path.unlink(missing_ok=True)
            if product.exists():
                path.symlink_to(os.path.relpath(product.resolve(), directory.resolve()))


def _scene_of(directory: Path) -> str | None:
    """Return the text of the scene that ran last in a directory; None if it cannot be read."""
    try:
        return (directory / "scene.toml").read_text(encoding="utf-8")
    except (OSError, ValueError):
        return None


def newer_products(report: Path) -> list[Path]:
    """Return the products in a run directory, also those of variants, that are newer than this file of its report."""
    made = report.stat().st_mtime
    return [path for path in report.parent.parent.rglob("*.h5")
            if path.name in FILE_OF.values() and path.is_file() and path.stat().st_mtime > made]


def step_path(settings: Simulation, directory: Path) -> Path | None:
    """Return the file that holds the converged step of a rollout: in `directory`, its run directory, or in the one that
    [simulation] step_from names. None if the step is a number."""
    if settings.step != CONVERGED:
        return None
    return settings.step_file or directory / STAGES["find-step"].file


def read_found_step(path: Path, comm: Comm) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read the attributes of a converged step, and the table of the trials with its integrator; all ranks call it."""
    with open_product(comm, path, "step") as file:
        found = read_attributes(file, "found")
        return found, read_table(file, f"trials/{found['integrator']}")


def stage_seconds(directory: Path) -> dict[str, float]:
    """Return the wall time of each stage in earlier runs, in seconds; empty if the file is missing or damaged."""
    try:
        return read_stage_seconds(directory)
    except (OSError, ProductError):
        return {}


def read_stage_seconds(directory: Path) -> dict[str, float]:
    """Return the wall time of each stage in earlier runs, in seconds; empty if the file is missing. Raises ProductError
    if the file is damaged."""
    path = directory / SECONDS
    if not path.exists():
        return {}
    try:
        return {stage: float(value) for stage, value in json.loads(path.read_text()).items()}
    except (AttributeError, TypeError, ValueError):
        raise ProductError(f"{path}: is damaged; delete it: the report does not need it") from None


def changed_settings(stage: Stage, then: str | None, now: str | None) -> list[str]:
    """Return the settings that differ between two scenes and affect the product of a stage, as text with both values.

    `then` and `now` are the scenes as TOML. The list is empty if one of them is missing or damaged.
    """
    stages = [STAGES[name] for name in (*stage.depends_on, stage.name)]
    try:
        before, after = (dict(dotted(tomllib.loads(text or ""))) for text in (then, now))
    except (TypeError, ValueError):
        return []
    if not before or not after:
        return []
    return [f"{key} = {_value(before, key)}, now {_value(after, key)}"
            for key in dict.fromkeys([*after, *before]) if before.get(key) != after.get(key)
            and any(key.partition(".")[0] in each.reads and key not in each.but for each in stages)]


def differences(stage: Stage, origin: Mapping[str, Any], scene: Scene) -> list[str] | None:
    """Return the settings in which a product of a stage differs from a scene, as `changed_settings`; None if it was
    made with the settings of the scene.

    `origin` is the provenance of the product. The list is empty if only the content of files differs, such as weights,
    or if such a file is not found.
    """
    if origin.get("fingerprint") == stage_fingerprint(scene, stage.name):
        return None
    return changed_settings(stage, origin.get("scene"), scene.to_toml())


def of_other_settings(changes: Sequence[str]) -> str:
    """Return the words "other settings", followed by the first few of `changes`."""
    listed = [*changes[:MOST_CHANGES], *(["..."] if changes[MOST_CHANGES:] else [])]
    return "other settings" + (f" ({', '.join(listed)})" if listed else "")


def _check_readable(product: Path) -> None:
    """Raise ProductError if the system refuses to read a product; damaged content is not an error here."""
    with suppress(ContentError):
        open_to_read(product).close()


def _cost(origin: Mapping[str, Any], seconds: float | None) -> str:
    if not origin:
        return " (damaged, unfinished or of another version)"
    return f" (made {origin['date']})" if seconds is None else f" (took {duration(seconds)})"


def _value(settings: Mapping[str, Any], key: str) -> str:
    return quoted(settings[key]) if key in settings else "absent"
