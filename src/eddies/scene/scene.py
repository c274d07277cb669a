"""A scene: the description of a flow and of what is to be learned from it, as read from one TOML file.

An optional section that is absent is None, and then nothing is built for it. Variants of a scene are scenes that
differ from it in some keys.
"""

import copy
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from eddies.import_path import search_in
from eddies.scene.checks import OF_THE_WHOLE, REALISATION, problems
from eddies.scene.layers import (BUILT_IN, OF_FILES, VARIANT, Layer, check_command_line, check_variant, command_line,
                                 dotted, read_document, with_sections)
from eddies.scene.model import Model
from eddies.scene.parts import Parts
from eddies.scene.rules import quoted
from eddies.scene.sections import (BOX_LENGTH, Eulerian, Flow, Forcing, Horizons, Initial, Kernel, Simulation, SpinUp,
                                   Time, Tracers, Training)
from eddies.scene.values import SceneError, read_section, sections, write_section

__all__ = ["BOX_LENGTH", "REALISATION", "Scene", "SceneError", "builtin_scenes", "load_scene", "Eulerian", "Flow",
           "Forcing", "Horizons", "Initial", "Kernel", "Model", "Simulation", "SpinUp", "Time", "Tracers", "Training"]


@dataclass(frozen=True, kw_only=True)
class Scene(Parts):
    """A whole scene; making one checks its values and that its sections fit together (SceneError).

    `variant` has the scenes of the variants by name, each whole and without variants of its own.
    """

    variant: "Mapping[str, Scene]" = sections()

    def __post_init__(self) -> None:
        super().__post_init__()
        for problem in problems(self):
            raise problem

    @property
    def without_variants(self) -> "Scene":
        """The scene without variants and realisations."""
        return replace(self, variant={}, realisations=None) if self.variant or self.realisations else self

    def check_variants(self, names: Sequence[str]) -> None:
        """Raise SceneError for a name that is not one of the variants."""
        for name in names:
            check_variant(name, self.variant, self.name)

    def to_toml(self, all_keys: bool = False) -> str:
        """Return the scene as a TOML text with a comment on every key, and the changed keys of each variant.

        Reading it back gives an equal scene. With `all_keys` comments list the absent keys and sections too.
        """
        lines = write_section(self, all_keys=all_keys)
        for name, scene in self.variant.items():
            lines += ["", f"[{VARIANT}.{name}]", *self.differences(scene)]
        return "\n".join(lines) + "\n"

    def differences(self, variant: "Scene") -> Iterator[str]:
        """Yield the lines of a variant's table: the keys in which it differs, `key = value`."""
        own, other = (dict(dotted(tomllib.loads("\n".join(write_section(scene)))))
                      for scene in (self.without_variants, variant))
        for name in set(OF_THE_WHOLE) & {*own, *other}:
            own.pop(name, None), other.pop(name, None)
        held = Layer(other).keys
        removed = dict.fromkeys(next(part for part in with_sections(key) if part not in held)
                                for key in own if key not in held)
        if removed:
            yield f"unset = {quoted([*removed])}"
        yield from (f"{key} = {quoted(value)}" for key, value in other.items() if own.get(key) != value)


def load_scene(name_or_path: str | Path, overrides: Sequence[str] = (), removals: Sequence[str] = ()) -> Scene:
    """Read a scene with its variants: a built-in one by name, or a TOML file by path.

    First the `removals` "section.key" or "section" are taken out, then the `overrides` "section.key=value" are set.
    Modules of the user's classes are searched in Python's own folders, then beside the file, then in the working
    directory.

    Raises SceneError, with the file (or --set, --unset), the section, the key, what is allowed, and a remedy.
    """
    path, document = read_document(str(name_or_path))
    search_in(path.parent)
    search_in(Path())
    given = Layer({})
    try:
        given = command_line(overrides, removals)
        existing = [*_tables_of_variants(document)]
        given.apply(document)
        document.setdefault("name", path.stem)
        variants = {name: Layer.of_table(table) for name, table in _tables_of_variants(document).items()}
        document.pop(VARIANT, None)
        check_command_line(given, variants, existing)
        scene = read_section(Scene, document, others=(*OF_FILES, VARIANT))
        return replace(scene, variant={name: _variant(document, name, layer) for name, layer in variants.items()})
    except SceneError as error:
        option = ", --set" if error.key in given.keys else ", --unset" if error.key in removals else ""
        raise SceneError(f"{path}{option}: {error}", error.key) from None


def _tables_of_variants(document: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The changed keys of each variant of a document; SceneError where [variant] is not a section of sections."""
    tables = document.get(VARIANT, {})
    if not isinstance(tables, dict) or not all(isinstance(table, dict) for table in tables.values()):
        raise SceneError(f"{VARIANT}: must be sections; write [{VARIANT}.NAME] and the changed keys below", VARIANT)
    return tables


def _variant(document: dict[str, Any], name: str, layer: Layer) -> Scene:
    """The scene of a variant: the document with the variant's changes."""
    try:
        for key in layer.values:
            if key.partition(".")[0] in OF_THE_WHOLE:
                raise SceneError(f"{key}: a variant cannot change this key; remove it", key)
        changed = {key: copy.deepcopy(value) for key, value in document.items() if key != "realisations"}
        layer.apply(changed)
        return read_section(Scene, {**changed, "name": name}, others=OF_FILES)
    except SceneError as error:
        raise SceneError(f'variant "{name}": {error}', error.key) from None


def builtin_scenes() -> list[tuple[str, str]]:
    """Return name and title of every scene that comes with the package, by name."""
    return [(path.stem, read_document(path.stem)[1]["title"]) for path in sorted(BUILT_IN.glob("*.toml"))]
