"""The work that a run directory holds: products and checkpoints.

Work that fits the settings of the scene is kept or continued. Other work would be replaced.
"""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from eddies.clock import duration
from eddies.errors import UserError
from eddies.io.checkpoint import checkpoints_in
from eddies.io.damage import open_to_read
from eddies.io.errors import ContentError, ProductError
from eddies.io.hdf5 import open_product, read_attributes, read_table
from eddies.io.provenance import product_fingerprint, product_provenance
from eddies.parallel.communicator import Comm
from eddies.pipeline import STAGES, Stage
from eddies.scene.layers import dotted
from eddies.scene.rules import quoted
from eddies.scene.scene import Scene, Simulation
from eddies.scene.sections import CONVERGED
from eddies.workflows.run_directory.fingerprints import DURATION_KEYS, set_files, stage_fingerprint

SECONDS = "stage_seconds.json"
FAILURE = "failure.txt"  # the error of a failed variant
MOST_CHANGES = 3  # largest number of changed settings that a message names


class WouldReplaceWork(UserError):
    """A command would replace work that was made with other settings."""


@dataclass(frozen=True)
class Work:
    """The work that stages find in a run directory."""

    directory: Path
    done: frozenset[str]  # stages whose product is complete and was made with the same settings
    begun: frozenset[str]  # stages that continue from a checkpoint
    obsolete: frozenset[str]  # stages whose checkpoints are left over from a complete run, or belong to other settings
    lost: tuple[str, ...]  # the files that the stages would replace, each with its wall time or date
    changes: tuple[str, ...]  # the settings that differ from those of the lost files

    def refuse_to_lose(self) -> None:
        """Raise WouldReplaceWork if anything would be replaced."""
        if self.lost:
            raise WouldReplaceWork(f"{self.directory}: holds work of {of_other_settings(self.changes)} that would "
                                   f"be replaced: {', '.join(self.lost)}; add --overwrite to replace it, or choose "
                                   "another --output")


def find_work(stages: Sequence[str], scene: Scene, directory: Path, links: Collection[str] = (),
              overwrite: bool = True) -> Work:
    """Find the work of a scene's stages that a run directory already holds; one rank calls it.

    `links` are further stages, whose products are links to other directories. Raises WouldReplaceWork if work would be
    replaced and `overwrite` is false. Raises ProductError if the system refuses to read a product or a checkpoint: such
    a file may be undamaged, and must not be replaced.
    """
    done, begun, obsolete, lost, changes = set(), set(), set(), [], {}
    seconds = stage_seconds(directory)
    for stage in [STAGES[name] for name in (*links, *stages) if STAGES[name].product is not None]:
        product, settings = directory / stage.file, stage_fingerprint(scene, stage.name)
        checkpoints = checkpoints_in(directory / stage.checkpoints) if stage.checkpoints else []
        keys = DURATION_KEYS.get(stage.name)
        continued = stage_fingerprint(scene, stage.name, keys) if keys else settings
        of_others = checkpoints and continued not in [fingerprint for _, fingerprint in checkpoints]
        origin = product_provenance(product)
        complete, sets = origin.get("fingerprint") == settings, set_files(scene) if stage.name == "dns" else {}
        of_sets = {path: product_provenance(directory / path) for path in sets}
        if complete and all(of_sets[path].get("fingerprint") == fingerprint for path, fingerprint in sets.items()):
            done.add(stage.name)
            # Checkpoints of other settings may still be continued. Those of a direct simulation serve a longer run.
            if not of_others and stage.name != "dns":
                obsolete.add(stage.name)
            continue
        for path, fingerprint in sets.items():
            if of_sets[path].get("fingerprint") != fingerprint and (directory / path).is_file():
                lost.append(f"{path}{_cost(of_sets[path], None)}")
                changes |= dict.fromkeys(changed_settings(stage, of_sets[path].get("scene"), scene.to_toml()))
        same_course = checkpoints and not of_others and origin.get("course") == continued and stage.name not in links
        if same_course and origin["duration"] > scene.duration:
            obsolete.add(stage.name)  # the checkpoint may lie after the end of the shorter run
        elif same_course:
            begun.add(stage.name)
            continue
        if product.is_file() and not product.is_symlink() and not complete:
            if not origin:
                _check_readable(product)
            lost.append(stage.file + _cost(origin, seconds.get(stage.name)))
            changes |= dict.fromkeys(changed_settings(stage, origin.get("scene"), scene.to_toml()))
        if checkpoints and not of_others and stage.name not in obsolete:
            begun.add(stage.name)
        if of_others:
            obsolete.add(stage.name)
            if origin.get("course") in [fingerprint for _, fingerprint in checkpoints]:
                continue  # the checkpoint holds the last state of the product, and the product is already in `lost`
            seconds_so_far = seconds.get(stage.name)
            cost = "" if seconds_so_far is None else f", took {duration(seconds_so_far)}"
            lost.append(f"{stage.checkpoints} (step {checkpoints[0][0]}{cost})")
            changes |= dict.fromkeys(changed_settings(stage, _scene_of(directory), scene.to_toml()))
    work = Work(directory, frozenset(done), frozenset(begun), frozenset(obsolete), tuple(lost), tuple(changes))
    if not overwrite:
        work.refuse_to_lose()
    return work


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
