"""The base class of the sections of a scene, and functions to declare, read and write sections.

A section is a frozen dataclass. Each field declares a key by a function (`number`, `numbers`, `integer`, `integers`,
`boolean`, `choice`, `named`, `text` or `texts`). Its arguments are the meaning of the key (`about`), the allowed values
and the default. Errors, written scenes, the reference page and the JSON schema use this one declaration. It applies to
objects made in a program and to those read from a TOML file.
"""

import dataclasses
import inspect
import re
from collections.abc import Iterator, Sequence
from dataclasses import MISSING
from pathlib import Path
from typing import Any, ClassVar

from eddies.errors import UserError
from eddies.import_path import is_path
from eddies.pipeline import STAGES
from eddies.scene.rules import Bounds, Rule, nearest, quoted, shortened

# The value that makes an optional key absent.
ABSENT = "none"


class SceneError(UserError, ValueError):
    """A scene cannot be used; the text gives the value, the allowed values, and a remedy.

    `key` is the "section.key" at fault; empty if no single key is at fault.
    """

    def __init__(self, message: str, key: str = ""):
        super().__init__(message)
        self.key = key


class KeyProblem(SceneError):
    """A problem with one key of a section."""

    def __init__(self, section: str, key: str, problem: str):
        super().__init__(f"{key_name(key, section)}{problem}", f"{section}.{key}" if section else key)
        self.section, self._parts = section, (key, problem)

    def within(self, section: str) -> "KeyProblem":
        """Return the same error with another section name in the message."""
        return KeyProblem(section, *self._parts)


class Section:
    """Base class of the sections of a scene. The constructor checks every value and stores what `Rule.accept` returns.

    Raises KeyProblem for a value that its declaration does not allow.

    Attributes
    ----------
    _holder : name of the field that maps NAME to the inner section [SECTION.NAME]; empty for a class without them.
    """

    _holder: ClassVar[str] = ""
    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field]]

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            object.__setattr__(self, field.name, self._accepted(field, getattr(self, field.name)))

    @classmethod
    def section_name(cls) -> str:
        """Return the name of the section in errors: the name of the class, written as in scenes."""
        return re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()

    def problem(self, key: str, problem: str) -> KeyProblem:
        """Return an error about a key; its text begins with the key and its value."""
        return KeyProblem(self.section_name(), key, f" = {shortened(quoted(getattr(self, key)))}: {problem}")

    def _accepted(self, field: dataclasses.Field, value: Any) -> Any:
        rule = rule_of(type(self), field)
        if field.default is None and (value is None or isinstance(value, str) and value == ABSENT):
            return None
        if rule is not None:
            try:
                return rule.accept(value)
            except ValueError as error:
                allowed, hint = rule.allowed + _meaning(rule), f"; {error}" if str(error) else ""
        elif field.metadata["section"] is None or isinstance(value, field.metadata["section"]):
            return value
        else:
            allowed, hint = f"a {field.metadata['section'].__name__}", ""
        raise self.problem(field.name, f"must be {allowed}{hint}")


def number(about: str, default: Any = MISSING, words: tuple[str, ...] = (), **bounds: float) -> Any:
    """Declare a dataclass field that holds a real number within `bounds` (see `Bounds`), or one of `words`."""
    return _declare(Rule(float, about, Bounds(**bounds), words), default)


def integer(about: str, default: Any = MISSING, **bounds: float) -> Any:
    """Declare a dataclass field that holds a whole number within `bounds` (see `Bounds`)."""
    return _declare(Rule(int, about, Bounds(**bounds)), default)


def integers(about: str, default: Any = MISSING, **bounds: float) -> Any:
    """Declare a dataclass field that holds a tuple of whole numbers, each within `bounds` (see `Bounds`)."""
    return _declare(Rule(int, about, Bounds(**bounds), many=True), default)


def numbers(about: str, default: Any = MISSING, words: tuple[str, ...] = (), **bounds: float) -> Any:
    """Declare a dataclass field that holds a tuple of real numbers, each within `bounds` (see `Bounds`), or one of
    `words`."""
    return _declare(Rule(float, about, Bounds(**bounds), words, many=True), default)


def boolean(about: str, default: Any = MISSING) -> Any:
    """Declare a dataclass field that holds True or False."""
    return _declare(Rule(bool, about), default)


def choice(about: str, *words: str, default: Any = MISSING) -> Any:
    """Declare a dataclass field that holds one of `words`."""
    return _declare(Rule(str, about, words=words), default)


def named(about: str, *words: str, default: Any = MISSING) -> Any:
    """Declare a dataclass field that holds one of `words`, or the import path "module:name" of a user's own class."""
    return _declare(Rule(str, about, words=words, paths=True), default)


def text(about: str, default: Any = MISSING) -> Any:
    """Declare a dataclass field that holds a string."""
    return _declare(Rule(str, about), default)


def column(about: str, default: Any = None) -> Any:
    """Declare a dataclass field that holds the name of a column, or its number from 1 on."""
    return _declare(Rule(str, about, numbered=True), default)


def texts(about: str, *words: str, default: Any = MISSING, paths: bool = False) -> Any:
    """Declare a dataclass field that holds a tuple of strings.

    If `words` are given, each string must be one of them or, if `paths` is true, the import path of a user's own class.
    """
    return _declare(Rule(str, about, words=words, paths=paths, many=True), default)


def section(kind: type, default: Any = MISSING) -> Any:
    """Declare a dataclass field that holds a section of the class `kind`, or None if the section is absent."""
    return dataclasses.field(default=default, metadata={"section": kind})


def sections() -> Any:
    """Declare a dataclass field that holds a dict of sections. The class with this field checks them itself."""
    return dataclasses.field(default_factory=dict, metadata={"section": None})


def rule_of(kind: type, field: dataclasses.Field) -> Rule | None:
    """Return the rule that a field declares, or else the rule of its annotation; None for a field that holds sections.

    Raises SceneError for a field with neither rule.
    """
    if "section" in field.metadata:
        return None
    if "rule" in field.metadata:
        return field.metadata["rule"]
    annotation = field.type if isinstance(field.type, str) else inspect.formatannotation(field.type)
    rule = ANNOTATIONS.get(annotation.removesuffix(" | None"))
    if rule is None:
        raise SceneError(f"{kind.__qualname__}.{field.name}: {annotation}: declare the key by a function of "
                         f"eddies (number, integer, boolean, text, ...), or annotate it with one of "
                         f"{', '.join(ANNOTATIONS)}")
    return rule


#: The rules of fields with an annotation but no declaration.
ANNOTATIONS = {"float": Rule(float), "int": Rule(int), "bool": Rule(bool), "str": Rule(str),
               "tuple[int, ...]": Rule(int, many=True), "tuple[float, ...]": Rule(float, many=True)}


def read_section(kind: type[Section], table: Any, name: str = "", others: Sequence[str] = ()) -> Any:
    """Make a section of the class `kind` from a TOML table.

    `name` is the name of the section, empty for the whole document. An error about an unknown key lists the keys of the
    class and `others`. Raises SceneError for an unknown key, a missing key, or a value that is not allowed.
    """
    if not isinstance(table, dict):
        message = f"{name} = {shortened(quoted(table))}: must be a section; write [{name}] and its keys below"
        raise SceneError(message, name)
    fields = {field.name: field for field in dataclasses.fields(kind) if field.metadata.get("section", kind)}
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key in fields:
            inner = fields[key].metadata.get("section")
            values[key] = read_section(inner, value, f"{name}.{key}" if name else key) if inner else value
        elif kind._holder and isinstance(value, dict):
            values.setdefault(kind._holder, {})[key] = value
        else:
            raise _unknown_key(key, value, name, [*fields, *others])
    for key, field in fields.items():
        rule = rule_of(kind, field)
        if rule is not None and key not in values and field.default is field.default_factory is MISSING:
            raise KeyProblem(name, key, f": this key is missing{_meaning(rule)}; give it {rule.allowed}")
    try:
        return kind(**values)
    except KeyProblem as problem:
        raise (problem.within(name) if problem.section == kind.section_name() else problem) from None


def _unknown_key(key: str, value: Any, section: str, valid: Sequence[str]) -> SceneError:
    is_section = isinstance(value, dict) and not section
    problem = (f": no such {'section' if is_section else 'key'}; {nearest(key, valid, cutoff=0.5)}valid here: "
               f"{', '.join(valid) or 'no key; remove it'}")
    return SceneError(f"[{key}]{problem}", key) if is_section else KeyProblem(section, key, problem)


def write_section(section: Section, name: str = "", all_keys: bool = False) -> list[str]:
    """Return the lines `key = value  # meaning` of a section and of its inner sections.

    Absent keys and sections, and sections without keys, are left out. If `all_keys` is true, comments list what is
    absent. An inner section does not repeat lines of the outer section.
    """
    lines, inner = [], []
    for field in dataclasses.fields(section):
        value, rule = getattr(section, field.name), rule_of(type(section), field)
        own = f"{name}.{field.name}" if name else field.name
        if rule is not None and (value is not None or all_keys):
            lines.append(_line(field.name, rule, value))
        elif rule is None and isinstance(value, Section):
            inner += ["", f"[{own}]", *write_section(value, own, all_keys)]
        elif rule is None and value is None and all_keys:
            kind = field.metadata["section"]
            inner += ["", f"# [{own}]  # {kind.__doc__.splitlines()[0]}"]
            inner += [f"# {line.removeprefix('# ')}" for line in _declared_lines(kind)]
        elif field.name == section._holder:
            for key, part in value.items():
                written = [line for line in write_section(part, all_keys=all_keys) if line not in lines]
                same = isinstance(part, type(section))
                if same:  # write keys that are absent here, or the outer section would give their values
                    written += [f'{each.name} = "{ABSENT}"' for each in dataclasses.fields(part)
                                if getattr(part, each.name) is None and getattr(section, each.name) is not None]
                if written or same:
                    inner += ["", f"[{name}.{key}]", *written]
    return lines + inner


def _declared_lines(kind: type[Section]) -> list[str]:
    """Return the lines of the keys of an absent section, with their defaults."""
    rules = [(field, rule_of(kind, field)) for field in dataclasses.fields(kind)]
    return [_line(field.name, rule, None if field.default is MISSING else field.default) for field, rule in rules
            if rule is not None]


def _line(key: str, rule: Rule, value: Any) -> str:
    given = f"# {key}: {rule.allowed}" if value is None else f"{key} = {quoted(value)}"
    return f"{given}  # {rule.about}" if rule.about else given


def import_paths(part: Section) -> Iterator[tuple[str, str]]:
    """Yield (key, import path) for each import path in a section and in its inner sections; a key has the form "key" or
    "section.key"."""
    for field in dataclasses.fields(part):
        rule, value = rule_of(type(part), field), getattr(part, field.name)
        if rule is not None and rule.paths:
            yield from ((field.name, path) for path in ((value,) if isinstance(value, str) else value or ())
                        if is_path(path))
        inner = {field.name: value} if isinstance(value, Section) else value if field.name == part._holder else {}
        for name, section in inner.items():
            yield from ((f"{name}.{key}", path) for key, path in import_paths(section))


def expanded(path: str) -> Path:
    """Return a path with the home directory in place of `~`, unless the home directory is unknown."""
    try:
        return Path(path).expanduser()
    except RuntimeError:  # no such user
        return Path(path)


def product_file(path: str, stage: str) -> Path:
    """Return the file of a stage's product: `path` itself if it ends in .h5, else the product in the run directory
    `path`."""
    file = expanded(path)
    return file if path.endswith(".h5") else file / STAGES[stage].file


def key_name(key: str, section: str) -> str:
    """Return the name of a key in errors: "[section] key", or the key alone if it is in no section."""
    return f"[{section}] {key}" if section else key


def _meaning(rule: Rule) -> str:
    return f" ({rule.about})" if rule.about else ""


def _declare(rule: Rule, default: Any) -> Any:
    return dataclasses.field(default=default, metadata={"rule": rule})
