"""The layers of a scene: its base, its own file, a variant, and the command line.

Each layer changes the keys of a TOML document in the same way: first it removes some keys or sections, then it sets
others. The order is base, scene, variant, command line.
"""

from __future__ import annotations

import copy
import os
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

from eddies.io.file_patterns import matching_files
from eddies.scene.model import replace_terms
from eddies.scene.rules import nearest, quoted, shortened
from eddies.scene.values import SceneError

BUILT_IN = Path(__file__).parents[1] / "scenes"
VARIANT = "variant"
FILE_ONLY_KEYS = ("base", "unset")  # keys that only a file may have
FILE_KEYS = {"initial": ("path",), "tracks": ("path",), "reconstruction": ("points",),
             "model": ("path",), "training": ("truths",), "simulation": ("step_from", "confirmed_on")}
OF_VARIANTS = ("model", "training", "simulation", "eulerian")  # sections that only the variants of a scene use, if any
DEEPEST = 3  # largest number of parts of a key, as in section.sub.key; [variant.NAME] adds two

Document = dict[str, Any]


@dataclass(frozen=True)
class Layer:
    """Changes to a document.

    Parameters
    ----------
    values : new values by dotted key, such as "flow.cells"; an empty table adds a section that is absent.
    unset : dotted keys and sections that are removed first.
    """

    values: Mapping[str, Any]
    unset: Sequence[str] = ()

    @classmethod
    def of_table(cls, table: Mapping[str, Any]) -> Layer:
        """Make the layer of a TOML table, whose key `unset` lists the removals."""
        unset = table.get("unset", [])
        if not (isinstance(unset, list) and all(isinstance(entry, str) and entry for entry in unset)):
            raise SceneError(f'unset = {shortened(quoted(unset))}: must be a list of keys or sections, such as '
                             '["training", "tracers.filter_width"]', "unset")
        return cls(dict(dotted({key: value for key, value in table.items() if key != "unset"})), unset)

    @property
    def keys(self) -> frozenset[str]:
        """The keys that are set, with the sections that hold them."""
        return frozenset(part for key in self.values for part in with_sections(key))

    def apply(self, document: Document) -> None:
        """Change the document in place.

        Raises SceneError if a key to remove is missing, or if the document has a value where a key needs a section.
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
            valid = table if isinstance(table, dict) else document
            raise SceneError(f"{shortened(removal)}: there is no such key or section to remove; there "
                             f"are: {', '.join(valid) or 'none'}", removal) from None


def dotted(table: Mapping[str, Any], within: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (dotted key, value) for each value in a table and its inner tables; an empty table counts as a value.

    `within` is the dotted name of the table; empty for the whole document.
    """
    for name, value in table.items():
        key = f"{within}.{name}" if within else name
        if isinstance(value, dict) and value:
            yield from dotted(value, key)
        else:
            yield key, value


def with_sections(key: str) -> Iterator[str]:
    """Yield the sections that hold a dotted key, the outermost first, then the key."""
    return accumulate(key.split("."), "{}.{}".format)


def read_document(name_or_path: str, above: Sequence[Path] = ()) -> tuple[Path, Document]:
    """Return the path of a scene's file, and the document of the scene.

    If the scene has a base, its document is that of the base with the changes in the file. If the file has variants,
    they replace those of the base. `above` holds the files of the scenes that have this one as a base, directly or
    through others. Raises SceneError if there is no such scene, a file is not TOML, or a scene is its own base.
    """
    path = _find(name_or_path, above[-1].parent if above else None)
    try:
        document = _parse(path)
        _find_files(document, path.parent)
        base = document.pop("base", None)
        if base is None:
            if "unset" in document:
                raise SceneError("unset: there is no base to remove keys from; remove unset, or add base", "unset")
            return path, document
        if not isinstance(base, str):
            raise SceneError(f"base = {shortened(quoted(base))}: must be the name or the path of a scene", "base")
        if path.resolve() in [other.resolve() for other in above]:
            raise SceneError(f'base = "{base}": this scene is its own base; remove one of the base keys', "base")
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


def _find(name_or_path: str, beside: Path | None) -> Path:
    """Return the file of the built-in scene with this name, or the file at this path.

    A relative path is first taken relative to `beside`, if given, then to the working directory. Raises SceneError if
    there is no such file.
    """
    names = sorted(path.stem for path in BUILT_IN.glob("*.toml"))
    if name_or_path in names:
        return BUILT_IN / f"{name_or_path}.toml"
    path = Path(name_or_path)
    remedy = f"give the path of a TOML file, or one of {', '.join(names)}"
    try:
        for candidate in ((beside / path, path) if beside is not None else (path,)):
            if candidate.is_file():
                return candidate
        is_directory = path.is_dir()
    except OSError as error:
        raise SceneError(f"{shortened(name_or_path)}: cannot be read: {error.strerror}; {remedy}") from None
    if is_directory:
        raise SceneError(f"{name_or_path}: is a directory, not a scene; give the path of a TOML file in it")
    raise SceneError(f"{shortened(name_or_path)}: no such scene; {nearest(name_or_path, names)}{remedy}")


def _find_files(document: Document, folder: Path) -> None:
    """Make the relative paths in a document absolute if their files exist in `folder`, the folder of the scene, but not
    in the working directory."""
    def found(path: str) -> str:
        beside = os.path.abspath(folder / path)
        exist = [os.path.exists(each) or bool(matching_files(each)) for each in (path, beside)]
        return beside if exist == [False, True] else path

    for key, value in document.items():
        if isinstance(value, dict):
            _find_files(value, folder)
            for name in FILE_KEYS.get(key, ()):
                path = value.get(name)
                if isinstance(path, str):
                    value[name] = found(path)
                elif isinstance(path, list):
                    value[name] = [found(each) if isinstance(each, str) else each for each in path]


def _parse(path: Path) -> Document:
    """Return the tables and keys of a TOML file. Raises SceneError, with the line at fault, if it cannot be read."""
    try:
        # Some editors begin a file with a byte order mark.
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except RecursionError:
        raise SceneError("is not a scene: its brackets are nested too deep; values have at most two levels") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise SceneError(f"cannot be read: {reason}; give the path of a scene, a TOML file") from None
    except ValueError as error:  # from TOML, or from a number with thousands of digits
        raise SceneError(f"not TOML: {error}; keys are written `key = value` under a [section]") from None


def command_line(overrides: Sequence[str], removals: Sequence[str]) -> Layer:
    """Make the layer of the options `--set` (`overrides`) and `--unset` (`removals`).

    A value is read as TOML; if it is not TOML, it is a string without quotes. Raises SceneError for an override that is
    not "section.key=value".
    """
    values = {}
    for override in overrides:
        key, equals, value = (part.strip() for part in override.partition("="))
        names = key.split(".")
        most = DEEPEST + 2 if names[0] == VARIANT else DEEPEST
        if not equals or not value or len(names) > most or not all(names):
            raise SceneError(f"--set {shortened(override)}: must be section.key=value, or key=value outside sections, "
                             "or section.name.key=value in a nested section; for one variant, "
                             "variant.NAME.section.key=value")
        if key in FILE_ONLY_KEYS:
            raise SceneError(f"--set {shortened(override)}: {key} can only be set in a file; "
                             + ("use --unset" if key == "unset" else "write a scene with this base"))
        values[key] = _parsed(value)
    return Layer(values, removals)


def _parsed(value: str) -> Any:
    try:
        parsed = tomllib.loads(f"value = {value}")
    except (ValueError, RecursionError):
        return value
    return parsed["value"] if len(parsed) == 1 else value


def check_command_line(given: Layer, variants: Mapping[str, Layer], existing: Iterable[str]) -> None:
    """Raise SceneError if the command line changes an unknown variant, a key that a variant changes itself, or a key
    that has no effect because all variants remove it.

    `given` is the layer of the command line. `variants` holds the layers of the variants, and `existing` the names of
    the variants in the file. The error names the option that changes the key in one variant alone.
    """
    for option, keys, end in (("--set", given.values, "=..."), ("--unset", given.unset, "")):
        for key in keys:
            first, _, rest = key.partition(".")
            if first == VARIANT and rest:
                check_variant(rest.partition(".")[0], existing, key)
            for name, layer in variants.items() if first != VARIANT else ():
                if any(f"{own}.".startswith(f"{key}.") for own in (*layer.values, *layer.unset)):
                    raise SceneError(f'{option} {key}: the variant "{name}" changes this key itself; use '
                                     f"{option} {VARIANT}.{name}.{key}{end}")
            removed = [any(f"{key}.".startswith(f"{own}.") for own in layer.unset) for layer in variants.values()]
            if first in OF_VARIANTS and removed and all(removed):
                raise SceneError(f"{option} {key}: has no effect, because each variant removes it; use {option} "
                                 f"{VARIANT}.NAME.{key}{end}")


def check_variant(name: str, variants: Iterable[str], where: str) -> None:
    """Raise SceneError for a name that is not one of the variants; the error begins with `where`."""
    if name not in variants:
        raise SceneError(f'{where}: there is no variant "{name}"; {nearest(name, variants)}there are: '
                         f"{', '.join(variants) or 'none'}")
