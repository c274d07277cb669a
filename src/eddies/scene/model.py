"""The section [model] of a scene: a list of terms, each with settings of its own in [model.NAME]."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar

from eddies.import_path import ImportPathError, is_path, load, short_name
from eddies.scene.rules import nearest, quoted
from eddies.scene.terms import DEFAULT_PRESET, GIVES, PRESETS, READS, TERMS, TermBase, TermSettings
from eddies.scene.values import (SceneError, Section, choice, number, product_file, read_section,
                                 sections, text, texts)

BUILT_IN_PREFIX = "eddies:"  # a [model] path with this prefix names weights of the package
WEIGHTS = Path(__file__).parents[1] / "weights"


def built_in_weights() -> list[str]:
    """Return the names of the package's trained weights, for [model] path."""
    return sorted(f"{BUILT_IN_PREFIX}{path.stem}" for path in WEIGHTS.glob("*.h5"))


@dataclass(frozen=True, kw_only=True)
class Model(Section):
    """The terms whose sum moves the particles, each with its settings; a preset is a named list of terms.

    `settings` maps the name of each term to its settings; in Python, these are given as an object or as a dict. When
    the section is made, the preset gives `terms` and the absent keys of `settings`. Then `preset` becomes None.
    """

    preset: str | None = choice(f"name of a predefined list of terms; absent: {DEFAULT_PRESET}, unless terms is given",
                                *PRESETS, default=None)
    terms: tuple[str, ...] | None = texts("names of the terms that give the acceleration and density of the particles; "
                                          "[model.NAME] has the keys of each", *TERMS, default=None, paths=True)
    neighbors: float | None = number("mean number of particles within the radius of interaction, only with terms that "
                                     "read pairs; absent: as in [kernel], or 60", default=None, at_least=8)
    path: str | None = text("run directory or model.h5 with the trained weights to use, or \"eddies:NAME\" for those "
                            "of a built-in scene in the package; absent: the weights are trained", default=None)
    settings: dict[str, TermSettings] = sections()
    _holder: ClassVar[str] = "settings"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.preset is not None and self.terms is not None:
            raise self.problem("preset", f"terms = {quoted(self.terms)} is given too, and both keys give the terms; "
                               "remove one of the two")
        if self.path is not None and self.path.startswith(BUILT_IN_PREFIX) and not self.weights_file.is_file():
            raise self.problem("path", "must be a run directory, a model.h5, or one of "
                               f"{', '.join(built_in_weights())}")
        preset = PRESETS[self.preset or DEFAULT_PRESET] if self.terms is None else {}
        terms = self.terms if self.terms is not None else tuple(preset)
        named = {short_name(term): term for term in terms}
        if len(named) < len(terms) or not terms:
            raise self.problem("terms", "must be one or more terms with different names; the name of an import path is "
                               "the part after the colon")
        for name in self.settings:
            if name not in named:
                raise SceneError(f"[model.{name}]: no such term; {nearest(name, named)}the terms are "
                                 f"{', '.join(named)}; remove the section, or add the term to the list",
                                 f"model.{name}")
        settings = {name: _settings(term, name, preset.get(name, {}), self.settings.get(name, {}))
                    for name, term in named.items()}
        for key, value in (("preset", None), ("terms", terms), ("settings", settings)):
            object.__setattr__(self, key, value)
        if self.neighbors is not None and "pairs" not in self.reads:
            raise self.problem("neighbors", f"none of the terms {quoted(terms)} reads pairs, so nothing has a radius "
                               "of interaction; remove the key")

    @property
    def weights_file(self) -> Path | None:
        """The file of the weights that `path` names; None without `path`."""
        if self.path is None or not self.path.startswith(BUILT_IN_PREFIX):
            return None if self.path is None else product_file(self.path, "train")
        return WEIGHTS / f"{self.path.removeprefix(BUILT_IN_PREFIX)}.h5"

    @property
    def reads(self) -> frozenset[str]:
        """The inputs of all terms together, such as "pairs"."""
        return frozenset(chain.from_iterable(settings.reads for settings in self.settings.values()))

    @property
    def gives(self) -> frozenset[str]:
        """The outputs of all terms together, such as "acceleration"."""
        return frozenset(chain.from_iterable(settings.gives for settings in self.settings.values()))

    @property
    def damping(self) -> str | None:
        """The name of the parameter with damping rates for a coarse grid, such as "damping.rates"; None without one."""
        return next((f"{name}.{one.damps_by}" for name, one in self.settings.items() if one.damps_by), None)


def replace_terms(table: dict[str, Any], keys: set[str]) -> None:
    """Remove `terms` from the table of [model] if a layer sets only `preset`, or `preset` if it sets only `terms`.

    Settings of terms that are then not in the list of terms are removed too, unless the layer sets them. `table` is the
    table after the layer has changed it. `keys` are the keys "section.key" and the sections that the layer sets.
    """
    if ("model.preset" in keys) == ("model.terms" in keys):
        return
    written, other = ("preset", "terms") if "model.preset" in keys else ("terms", "preset")
    table.pop(other, None)
    listed = PRESETS.get(str(table[written]), ()) if written == "preset" else table[written]
    if isinstance(listed, (list, dict)):
        names = {short_name(str(term)) for term in listed}
        for name in [name for name, part in table.items() if isinstance(part, dict) and name not in names]:
            if f"model.{name}" not in keys:
                del table[name]


def settings_class(term: str) -> type[TermSettings]:
    """Return the class of a term's settings: a class of this package, or `Settings` of a user's class.

    Raises ImportPathError for a wrong import path, SceneError if the class is not a term or its Settings are not valid.
    """
    if not is_path(term):
        return TERMS[term]
    kind = load(term)
    if not isinstance(kind, type) or not issubclass(kind, TermBase):
        raise SceneError(f'"{term}": must be a class derived from eddies.Term')
    settings = getattr(kind, "Settings", TermSettings)
    if not (isinstance(settings, type) and issubclass(settings, TermSettings)
            and "__dataclass_fields__" in vars(settings)):
        raise SceneError(f'"{term}": its Settings must be a dataclass derived from eddies.TermSettings; write '
                         "@dataclass(frozen=True) and below it class Settings(eddies.TermSettings)")
    return settings


def _settings(term: str, name: str, preset: Mapping[str, Any],
              given: TermSettings | Mapping[str, Any]) -> TermSettings:
    """Return the settings of a term: the object `given`, or an object made from the preset and the keys in `given`.

    `term` is the built-in name or the import path of the term, and `name` its name in the scene.
    """
    try:
        kind = settings_class(term)
    except (ImportPathError, SceneError) as error:
        raise SceneError(f"[model] terms: {error}", "model.terms") from None
    if isinstance(given, Section):
        if type(given) is not kind:
            raise SceneError(f"[model.{name}]: must be settings of the class {kind.__qualname__} or a dict of its "
                             f"keys, not settings of the class {type(given).__qualname__}", f"model.{name}")
        made = given
    else:
        made = read_section(kind, {**preset, **given} if isinstance(given, Mapping) else given, f"model.{name}")
    for key, valid in (("reads", READS), ("gives", GIVES)):
        declared = getattr(made, key)
        if isinstance(declared, str) or not set(declared) <= set(valid):
            raise SceneError(f"[model] terms: {quoted(term)}: {key} = {quoted(declared)}: must be a tuple of any of "
                             f"{', '.join(map(quoted, valid))}", "model.terms")
    return made
