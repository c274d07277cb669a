"""The layers of a scene: its base, its own file, a variant, the command line.

All layers are one operation on the keys of a TOML document: first some keys or sections are removed, then others are
set. The order is base, scene, variant, command line.
"""

from __future__ import annotations

import copy
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from typing import Any

from eddies.scene.model import replace_terms
from eddies.scene.reader import find_document, parse_document, read_text
from eddies.scene.rules import quoted, shortened
from eddies.scene.values import SceneError

BUILT_IN = Path(__file__).parents[1] / "scenes"
VARIANT = "variant"
OF_FILES = ("base", "unset")  # keys that a file alone has
# [section.sub.key], and the same in [variant.NAME].
DEEPEST = 3

Document = dict[str, Any]


@dataclass(frozen=True)
class Layer:
    """Changes of a document.

    Parameters
    ----------
    values : new values by dotted key, such as "flow.cells"; an empty table makes an absent section.
    unset : dotted keys and sections that are removed before.
    source : what begins a message about one of them.
    """

    values: Mapping[str, Any]
    unset: Sequence[str] = field(default=())
    source: str = ""

    @classmethod
    def of_table(cls, table: Mapping[str, Any]) -> Layer:
        """The layer that a TOML table describes; its key `unset` lists what is removed."""
        unset = table.get("unset", [])
        if not (isinstance(unset, list) and all(isinstance(entry, str) and entry for entry in unset)):
            raise SceneError(f'unset = {shortened(quoted(unset))}: must be a list of keys or sections, such as '
                             '["training", "tracers.filter_width"]', "unset")
        return cls(dict(dotted({key: value for key, value in table.items() if key != "unset"})), unset, "unset: ")

    @property
    def keys(self) -> frozenset[str]:
        """The keys that are set, with the sections that hold them."""
        return frozenset(part for key in self.values for part in with_sections(key))

    def apply(self, document: Document) -> None:
        """Change the document in place.

        Raises SceneError for a removal of what the document has not, and for a key below a value.
        """
        for removal in self.unset:
            self._remove(document, removal)
        for key, value in self.values.items():
            *outer, last = key.split(".")
            table = document
            for name in outer:
                table = table.setdefault(name, {})
                if not isinstance(table, dict):
                    raise SceneError(f"{key} = {shortened(quoted(value))}: {name} is a value, not a section", key)
            if value != {} or not isinstance(table.get(last), dict):
                table[last] = copy.deepcopy(value)
        if isinstance(document.get("model"), dict):
            replace_terms(document["model"], set(self.keys))

    def _remove(self, document: Document, removal: str) -> None:
        table: Any = document
        *outer, last = removal.strip().split(".")
        try:
            for name in outer:
                table = table[name]
            del table[last]
        except (KeyError, TypeError):
            known = table if isinstance(table, dict) else document
            raise SceneError(f"{self.source}{shortened(removal)}: there is no such key or section to remove; there "
                             f"are: {', '.join(known) or 'none'}", removal) from None


def dotted(table: Mapping[str, Any], within: str = "") -> Iterator[tuple[str, Any]]:
    """All values of nested tables by dotted key; an empty table counts as a value."""
    for name, value in table.items():
        key = f"{within}.{name}" if within else name
        if isinstance(value, dict) and value:
            yield from dotted(value, key)
        else:
            yield key, value


def with_sections(key: str) -> Iterator[str]:
    """A dotted key after the sections that hold it, the outermost first."""
    return accumulate(key.split("."), "{}.{}".format)


def read_document(name_or_path: str, above: Sequence[Path] = ()) -> tuple[Path, Document]:
    """The file of a scene, and its document over those of its bases; `above`: the files that it is a base of.

    Variants of a scene replace those of its base. Raises SceneError: there is no such scene, a file is no TOML, or a
    scene is its own base.
    """
    path = find_document(name_or_path, BUILT_IN, above[-1].parent if above else None)
    try:
        document = parse_document(read_text(path))
        base = document.pop("base", None)
        if base is None:
            if "unset" in document:
                raise SceneError("unset: there is no base to remove keys from; remove unset, or add base", "unset")
            return path, document
        if not isinstance(base, str):
            raise SceneError(f"base = {shortened(quoted(base))}: must be the name or the path of a scene", "base")
        if path.resolve() in [other.resolve() for other in above]:
            raise SceneError(f'base = "{base}": the scene is its own base; remove one of the keys', "base")
        try:
            below = read_document(base, [*above, path])[1]
        except SceneError as error:
            raise SceneError(f"base: {error}", "base") from None
        below.pop("name", None)
        if VARIANT in document:
            below.pop(VARIANT, None)
        Layer.of_table(document).apply(below)
        return path, below
    except SceneError as error:
        raise SceneError(f"{path}: {error}", error.key) from None


def command_line(overrides: Sequence[str], removals: Sequence[str]) -> Layer:
    """The layer of `--set` and `--unset`. A value is read as TOML; what is not TOML, such as a bare word, is a
    string.

    Raises SceneError for what is no "section.key=value".
    """
    values = {}
    for override in overrides:
        key, equals, value = (part.strip() for part in override.partition("="))
        names = key.split(".")
        most = DEEPEST + 2 if names[0] == VARIANT else DEEPEST
        if not equals or not value or len(names) > most or not all(names):
            raise SceneError(f"--set {shortened(override)}: must be section.key=value, or key=value outside sections, "
                             "or section.name.key=value in a section of a section; for one variant, "
                             "variant.NAME.section.key=value")
        if key in OF_FILES:
            raise SceneError(f"--set {shortened(override)}: {key} is a key of a file alone; "
                             + ("use --unset" if key == "unset" else "write a scene with this base"))
        values[key] = _parsed(value)
    return Layer(values, removals)


def refuse_keys_of_variants(given: Layer, variants: Mapping[str, Layer]) -> None:
    """Refuse a command line that sets or removes, for all variants, a key that a variant changes itself.

    Raises SceneError with the option that reaches this variant.
    """
    for name, layer in variants.items():
        for option, keys in (("--set", given.values), ("--unset", given.unset)):
            for key in keys:
                hit = any(f"{own}.".startswith(f"{key}.") for own in (*layer.values, *layer.unset))
                if hit and not key.startswith(f"{VARIANT}."):
                    raise SceneError(f'{option} {key}: the variant "{name}" changes this key itself; reach it by '
                                     f"{option} {VARIANT}.{name}.{key}" + ("=..." if option == "--set" else ""))


def _parsed(value: str) -> Any:
    try:
        parsed = tomllib.loads(f"value = {value}")
    except (ValueError, RecursionError):
        return value
    return parsed["value"] if len(parsed) == 1 else value
