"""What a single value of a scene may be.

Every key of a scene is declared once, beside the dataclass field that holds it, by one of the functions
`number`, `integer`, `integers`, `choice`, `text` and `texts`. The declaration carries a line on what the key means,
which values it accepts, and its default; the reader, the error messages and the written scene all use that
one declaration.
"""

import dataclasses
import json
import math
from dataclasses import MISSING, dataclass
from typing import Any


class SceneError(ValueError):
    """What the user asked for cannot be done: the text says what was given, what is allowed, and what to do.

    `key` is the "section.key" at fault where there is one.
    """

    def __init__(self, message: str, key: str = ""):
        super().__init__(message)
        self.key = key


@dataclass(frozen=True)
class Bounds:
    """The interval a number must lie in, open (`above`, `below`) or closed (`at_least`, `at_most`)."""

    above: float = -math.inf
    at_least: float = -math.inf
    below: float = math.inf
    at_most: float = math.inf

    def __contains__(self, number: float) -> bool:
        return self.above < number < self.below and self.at_least <= number <= self.at_most

    def __str__(self) -> str:
        limits = [f"{field.name.replace('_', ' ')} {getattr(self, field.name):g}"
                  for field in dataclasses.fields(self) if getattr(self, field.name) != field.default]
        return " and ".join(limits)


@dataclass(frozen=True)
class Number:
    """A finite real number within bounds, or one of a few words."""

    about: str
    bounds: Bounds = Bounds()
    words: tuple[str, ...] = ()

    def accept(self, value: Any) -> float | str:
        if isinstance(value, str) and value in self.words:
            return value
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise ValueError
        if value not in self.bounds:
            raise ValueError
        return float(value)

    @property
    def allowed(self) -> str:
        return " or ".join([f"a number {self.bounds}".rstrip(), *map(quoted, self.words)])


@dataclass(frozen=True)
class Integer:
    """A whole number within bounds."""

    about: str
    bounds: Bounds = Bounds()

    def accept(self, value: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or value not in self.bounds:
            raise ValueError
        return value

    @property
    def allowed(self) -> str:
        return f"a whole number {self.bounds}".rstrip()


@dataclass(frozen=True)
class Integers:
    """A non-empty list of whole numbers, each within bounds; held as a tuple."""

    about: str
    bounds: Bounds = Bounds()

    def accept(self, value: Any) -> tuple[int, ...]:
        if not isinstance(value, list) or not value:
            raise ValueError
        return tuple(Integer(self.about, self.bounds).accept(entry) for entry in value)

    @property
    def allowed(self) -> str:
        return f"a list such as [16, 16] of whole numbers, each {self.bounds}"


@dataclass(frozen=True)
class Texts:
    """A list of non-empty strings; held as a tuple."""

    about: str

    def accept(self, value: Any) -> tuple[str, ...]:
        if not isinstance(value, list):
            raise ValueError
        return tuple(Text(self.about).accept(entry) for entry in value)

    @property
    def allowed(self) -> str:
        return 'a list of texts, such as ["one", "two"]'


@dataclass(frozen=True)
class Choice:
    """One of a few words."""

    about: str
    words: tuple[str, ...] = ()

    def accept(self, value: Any) -> str:
        if not isinstance(value, str) or value not in self.words:
            raise ValueError
        return value

    @property
    def allowed(self) -> str:
        return "one of " + ", ".join(map(quoted, self.words))


@dataclass(frozen=True)
class Text:
    """A non-empty string."""

    about: str

    def accept(self, value: Any) -> str:
        if not isinstance(value, str) or not value:
            raise ValueError
        return value

    @property
    def allowed(self) -> str:
        return "a text in quotes"


def number(about: str, default: Any = MISSING, words: tuple[str, ...] = (), **bounds: float) -> Any:
    """Declare a dataclass field that holds a real number (or one of `words`)."""
    return _declare(Number(about, Bounds(**bounds), words), default)


def integer(about: str, default: Any = MISSING, **bounds: float) -> Any:
    """Declare a dataclass field that holds a whole number."""
    return _declare(Integer(about, Bounds(**bounds)), default)


def integers(about: str, default: Any = MISSING, **bounds: float) -> Any:
    """Declare a dataclass field that holds a tuple of whole numbers."""
    return _declare(Integers(about, Bounds(**bounds)), default)


def choice(about: str, *words: str, default: Any = MISSING) -> Any:
    """Declare a dataclass field that holds one of `words`."""
    return _declare(Choice(about, words), default)


def text(about: str, default: Any = MISSING) -> Any:
    """Declare a dataclass field that holds a string."""
    return _declare(Text(about), default)


def texts(about: str, default: Any = MISSING) -> Any:
    """Declare a dataclass field that holds a tuple of strings."""
    return _declare(Texts(about), default)


def section(kind: type, default: Any = MISSING) -> Any:
    """Declare a dataclass field that holds a whole section, itself a dataclass `kind` (None: absent)."""
    return dataclasses.field(default=default, metadata={"section": kind})


def sections(kind: type) -> Any:
    """Declare a dataclass field that holds a tuple of dataclasses `kind`, one for each [[section]] of its name."""
    return dataclasses.field(default=(), metadata={"sections": kind})


def quoted(value: Any) -> str:
    """The value as TOML writes it: strings in double quotes, tuples as lists, floats to full precision."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {quoted(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(quoted, value)) + "]"
    if isinstance(value, (bool, str)):
        return json.dumps(value, ensure_ascii=False)
    return repr(value) if isinstance(value, (int, float)) else str(value)


def _declare(rule: Any, default: Any) -> Any:
    return dataclasses.field(default=default, metadata={"rule": rule})
