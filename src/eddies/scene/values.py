"""What a section of a scene is: a frozen dataclass whose fields declare their keys.

Every key of a scene is declared once, beside the dataclass field that holds it, by one of the functions `number`,
`integer`, `integers`, `boolean`, `choice`, `named`, `text`, `directory_name` and `texts`. The declaration
carries a line on what the key means, which values it accepts, and its default; the reader, the error messages and the
written scene all use that one declaration. It is applied where an object is made, from a TOML file or in a program.
"""

import dataclasses
import inspect
import re
from collections.abc import Iterator
from dataclasses import MISSING
from pathlib import Path
from typing import Any, ClassVar

from eddies.errors import UserError
from eddies.scene.rules import Boolean, Bounds, Choice, Integer, Integers, Name, Number, Text, Texts, quoted, shortened


# Of a key that may be left out, in place of its value: as if it were.
ABSENT = "none"


class SceneError(UserError, ValueError):
    """What the user asked for cannot be done: the text says what was given, what is allowed, and what to do.

    `key` is the "section.key" at fault where there is one.
    """

    def __init__(self, message: str, key: str = ""):
        super().__init__(message)
        self.key = key


class KeyProblem(SceneError):
    """What is wrong with one key of a section, known by the section's name."""

    def __init__(self, section: str, key: str, problem: str):
        super().__init__(f"{place(key, section)}{problem}", f"{section}.{key}" if section else key)
        self.section, self._parts = section, (key, problem)

    def within(self, section: str) -> "KeyProblem":
        """The same of a section of another name."""
        return KeyProblem(section, *self._parts)


class Section:
    """Base of the dataclasses of a scene: making one checks every value, and holds it in the form of its rule.

    Raises KeyProblem for a value that its declaration refuses.

    Attributes
    ----------
    of_the_file : keys that a file may have beside those of the fields.
    """

    of_the_file: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            value = getattr(self, field.name)
            if isinstance(value, str) and value == ABSENT and field.default is None:
                object.__setattr__(self, field.name, None)
            elif not (value is None and field.default is None):
                object.__setattr__(self, field.name, _accepted(type(self), field, value))

    @classmethod
    def section_name(cls) -> str:
        """The name of the section in errors: that of the class, as a scene writes it."""
        return re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()


def number(about: str, default: Any = MISSING, words: tuple[str, ...] = (), **bounds: float) -> Any:
    """Declare a dataclass field that holds a real number (or one of `words`)."""
    return _declare(Number(about, Bounds(**bounds), words), default)


def integer(about: str, default: Any = MISSING, **bounds: float) -> Any:
    """Declare a dataclass field that holds a whole number."""
    return _declare(Integer(about, Bounds(**bounds)), default)


def integers(about: str, default: Any = MISSING, **bounds: float) -> Any:
    """Declare a dataclass field that holds a tuple of whole numbers."""
    return _declare(Integers(about, Bounds(**bounds)), default)


def boolean(about: str, default: Any = MISSING) -> Any:
    """Declare a dataclass field that holds True or False."""
    return _declare(Boolean(about), default)


def choice(about: str, *words: str, default: Any = MISSING) -> Any:
    """Declare a dataclass field that holds one of `words`."""
    return _declare(Choice(about, words), default)


def named(about: str, *words: str, default: Any = MISSING) -> Any:
    """Declare a dataclass field that holds one of `words`, or the import path "module:name" of something else."""
    return _declare(Choice(about, words, paths=True), default)


def text(about: str, default: Any = MISSING) -> Any:
    """Declare a dataclass field that holds a string."""
    return _declare(Text(about), default)


def directory_name(about: str, default: Any = MISSING) -> Any:
    """Declare a dataclass field that holds the name of a directory."""
    return _declare(Name(about), default)


def texts(about: str, *words: str, default: Any = MISSING, paths: bool = False) -> Any:
    """Declare a dataclass field that holds a tuple of strings, of `words` if any are given or, with `paths`, import
    paths."""
    return _declare(Texts(about, words, paths), default)


def section(kind: type, default: Any = MISSING) -> Any:
    """Declare a dataclass field that holds a whole section, itself a dataclass `kind` (None: absent)."""
    return dataclasses.field(default=default, metadata={"section": kind})


def sub_sections() -> Any:
    """Declare a dataclass field that holds a dict of the section's own sections [section.NAME], by NAME.

    The dataclass makes objects of their tables when it is made.
    """
    return dataclasses.field(default_factory=dict, metadata={"sub_sections": True})


def scenes() -> Any:
    """Declare a dataclass field that holds a dict of whole scenes by name."""
    return dataclasses.field(default_factory=dict, metadata={"scenes": True})


def rule_of(kind: type, field: dataclasses.Field) -> Any:
    """The rule of a field: as declared, or else that of its annotation; None for a field that holds sections.

    Raises SceneError where there is neither.
    """
    if field.metadata.keys() & {"section", "sub_sections", "scenes"}:
        return None
    if "rule" in field.metadata:
        return field.metadata["rule"]
    annotation = field.type if isinstance(field.type, str) else inspect.formatannotation(field.type)
    rule = ANNOTATIONS.get(annotation.removesuffix(" | None"))
    if rule is None:
        raise SceneError(f"{kind.__qualname__}.{field.name}: {annotation}: a key is declared by number, integer, "
                         f"boolean, text, ... of eddies, or its annotation is one of {', '.join(ANNOTATIONS)}")
    return rule


#: The rules of fields that a dataclass does not declare.
ANNOTATIONS = {"float": Number(""), "int": Integer(""), "bool": Boolean(""), "str": Text(""),
               "tuple[int, ...]": Integers("")}


def import_paths(part: Section) -> Iterator[tuple[str, str]]:
    """Each key of a section that may hold an import path, with the import paths that it holds."""
    for field in dataclasses.fields(part):  # type: ignore[arg-type]
        if getattr(rule_of(type(part), field), "paths", False):
            value = getattr(part, field.name)
            for name in (value,) if isinstance(value, str) else value or ():
                if ":" in name:
                    yield field.name, name


def product_file(path: str, name: str) -> Path:
    """The file of a product that a key names: the path itself where it ends in .h5, else NAME in that directory."""
    return Path(path) if path.endswith(".h5") else Path(path) / name


def place(key: str, section: str) -> str:
    """A key in words."""
    return f"[{section}] {key}" if section else key


def _accepted(kind: type[Section], field: dataclasses.Field, value: Any) -> Any:
    """The value of a field as its rule holds it."""
    def refusal(allowed: str, hint: str = "") -> KeyProblem:
        return KeyProblem(kind.section_name(), field.name,
                          f" = {shortened(quoted(value))}: must be {allowed}" + (f"; {hint}" if hint else ""))

    if field.metadata.keys() & {"sub_sections", "scenes"}:
        return value
    if "section" in field.metadata:
        if not isinstance(value, field.metadata["section"]):
            raise refusal(f"a {field.metadata['section'].__name__}")
        return value
    rule = rule_of(kind, field)
    try:
        return rule.accept(value)
    except ValueError as error:
        about = f" ({rule.about})" if rule.about else ""
        raise refusal(f"{rule.allowed}{about}", str(error)) from None


def _declare(rule: Any, default: Any) -> Any:
    return dataclasses.field(default=default, metadata={"rule": rule})
