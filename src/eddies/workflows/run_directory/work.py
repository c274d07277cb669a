"""What of the stages of a scene is in a run directory: what fits the scene's settings is kept or gone on with, what
does not would be lost to new work."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eddies.clock import duration
from eddies.errors import UserError
from eddies.io.checkpoint import checkpoints_in
from eddies.io.errors import ProductError
from eddies.io.provenance import product_provenance
from eddies.io.reading import cannot_be_read, open_to_read, why_unreadable
from eddies.pipeline import STAGES, Stage
from eddies.scene.rules import quoted
from eddies.scene.scene import Scene
from eddies.workflows.run_directory.fingerprints import stage_fingerprint

SECONDS = "stage_seconds.json"
FAILURE = "failure.txt"  # why a variant failed
MOST_CHANGES = 3  # that a refusal lists


class WorkAtStake(UserError):
    """A command would replace work that somebody may still want."""


@dataclass(frozen=True)
class Work:
    """What stages find in a run directory.

    Parameters
    ----------
    directory : the run directory.
    done : the stages whose product is complete and was made with the same settings.
    begun : the stages that go on from a checkpoint.
    useless : the stages whose checkpoints are of no use: left behind by a run that came to its end, or of other
        settings and to be replaced.
    lost : what they would replace, with what it cost, in words.
    changes : which settings differ from those that this was made with, in words.
    """

    directory: Path
    done: frozenset[str]
    begun: frozenset[str]
    useless: frozenset[str]
    lost: tuple[str, ...]
    changes: tuple[str, ...]

    def refuse_to_lose(self) -> None:
        """Raise WorkAtStake, which names it, if anything would be replaced."""
        if self.lost:
            raise WorkAtStake(f"{self.directory}: holds work of {of_other_settings(self.changes)} that would be "
                              f"replaced: {', '.join(self.lost)}; add --overwrite to replace it, or choose another "
                              "--output")


def find_work(stages: Sequence[str], scene: Scene, directory: Path) -> Work:
    """What stages of a scene find in a run directory. One rank calls it, the directory being locked.

    Raises ProductError where the system does not let a product be read: it may be sound.
    """
    done, begun, useless, lost, changes = set(), set(), set(), [], {}
    seconds = stage_seconds(directory)
    for stage in [STAGES[name] for name in stages if STAGES[name].product is not None]:
        product = directory / stage.file
        checkpoints = checkpoints_in(directory / stage.checkpoints) if stage.checkpoints else []
        found = [fingerprint for _, fingerprint in checkpoints]
        of_others = checkpoints and stage_fingerprint(scene, stage.name) not in found
        origin = product_provenance(product)
        if _fits(origin, stage.name, scene):
            done.add(stage.name)
            if not of_others:  # those may be gone on with by whoever wants to replace the product
                useless.add(stage.name)
            continue
        if product.is_file() and not product.is_symlink():
            if not origin:
                _refuse_unreadable(product)
            lost.append(stage.file + _cost(origin, seconds.get(stage.name)))
            changes |= dict.fromkeys(changed_settings(stage, origin.get("scene"), scene.to_toml()))
        if checkpoints and not of_others:
            begun.add(stage.name)
        if of_others:
            useless.add(stage.name)
            lost.append(f"{stage.checkpoints} (step {checkpoints[0][0]})")
    return Work(directory, frozenset(done), frozenset(begun), frozenset(useless), tuple(lost), tuple(changes))


def is_done(stage: str, scene: Scene, directory: Path) -> bool:
    """Whether the product of a stage is complete and was made with the same settings. One rank calls it."""
    return STAGES[stage].product is not None and _fits(
        product_provenance(directory / STAGES[stage].file), stage, scene)


def stage_seconds(directory: Path) -> dict[str, float]:
    """Wall time of each stage as earlier runs noted it; a file that is missing or damaged holds nothing worth an
    error."""
    try:
        return read_stage_seconds(directory)
    except (OSError, ProductError):
        return {}


def read_stage_seconds(directory: Path) -> dict[str, float]:
    """The same; ProductError where the file is damaged."""
    path = directory / SECONDS
    if not path.exists():
        return {}
    try:
        return {stage: float(value) for stage, value in json.loads(path.read_text()).items()}
    except (AttributeError, TypeError, ValueError):
        raise ProductError(f"{path}: is not what the stages wrote; delete it, the report does without") from None


def changed_settings(stage: Stage, then: str | None, now: str | None) -> list[str]:
    """The settings that the product of a stage depends on and that differ between the texts of two scenes, each with
    both values; none where a text is missing or damaged."""
    stages = [STAGES[name] for name in (*stage.depends_on, stage.name)]
    try:
        before, after = (dict(leaves(tomllib.loads(text or ""))) for text in (then, now))
    except (TypeError, ValueError):
        return []
    if not before or not after:
        return []
    return [f"{'.'.join(key)} = {_value(before, key)}, now {_value(after, key)}"
            for key in dict.fromkeys([*after, *before]) if before.get(key) != after.get(key)
            and any(key[0] in each.reads and ".".join(key) not in each.but for each in stages)]


def of_other_settings(changes: Sequence[str]) -> str:
    """That settings have changed, and the first of those that did, in words."""
    listed = [*changes[:MOST_CHANGES], *(["..."] if changes[MOST_CHANGES:] else [])]
    return "other settings" + (f" ({', '.join(listed)})" if listed else "")


def _refuse_unreadable(product: Path) -> None:
    """Raise ProductError where the system does not let a product be read, which may be sound."""
    try:
        open_to_read(product).close()
    except OSError as error:
        if reason := why_unreadable(error):
            raise ProductError(cannot_be_read(product, reason)) from None
    except ProductError:  # of its content
        return


def _fits(origin: Mapping[str, Any], stage: str, scene: Scene) -> bool:
    return origin.get("fingerprint") == stage_fingerprint(scene, stage)


def _cost(origin: Mapping[str, Any], seconds: float | None) -> str:
    if not origin:
        return " (damaged, unfinished or of another version)"
    return f" (made {origin['date']})" if seconds is None else f" (took {duration(seconds)})"


def _value(settings: Mapping[tuple[str, ...], Any], key: tuple[str, ...]) -> str:
    return quoted(settings[key]) if key in settings else "absent"


def leaves(table: Mapping[str, Any], within: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """All values of nested tables, each with the keys that lead to it."""
    for key, value in table.items():
        if isinstance(value, dict):
            yield from leaves(value, (*within, key))
        else:
            yield (*within, key), value
