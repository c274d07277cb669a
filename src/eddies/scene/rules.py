"""Rules of what a single value may be: each accepts a value, in the form in which it is held, or refuses it.

`accept` raises ValueError for what the rule refuses, with a hint at the nearest valid spelling where there is one;
`allowed` says in words what it accepts, and `about` what the value means.
"""

import dataclasses
import difflib
import json
import math
import numbers
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

IMPORT_PATH = 'the import path "module:name" of your own'
# Numbers of a scene: beyond these squares and cubes of them overflow, or a run has no end.
SMALLEST, LARGEST, MOST = 1e-15, 1e15, 10**9
# Characters of a value that an error shows, and bits of a whole number that Python writes with decimals.
SHOWN, MOST_BITS = 60, 10_000


@dataclass(frozen=True)
class Bounds:
    """The interval a number must lie in, open (`above`, `below`) or closed (`at_least`, `at_most`)."""

    above: float = -math.inf
    at_least: float = -math.inf
    below: float = math.inf
    at_most: float = math.inf

    def __contains__(self, number: Any) -> bool:
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
        try:
            finite = not isinstance(value, bool) and isinstance(value, numbers.Real) and math.isfinite(value)
        except OverflowError:  # a whole number of hundreds of digits
            finite = False
        if not finite:
            raise ValueError
        if value not in self.bounds:
            raise ValueError
        if value != 0 and not SMALLEST <= abs(float(value)) <= LARGEST:
            raise ValueError(f"numbers of a scene that are not 0 lie between {SMALLEST:g} and {LARGEST:g} in size")
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
        if isinstance(value, bool) or not isinstance(value, numbers.Integral) or value not in self.bounds:
            raise ValueError
        if abs(int(value)) > MOST and self.bounds.at_most == math.inf:
            raise ValueError(f"whole numbers of a scene are at most {MOST:,}")
        return int(value)

    @property
    def allowed(self) -> str:
        return f"a whole number {self.bounds}".rstrip()


@dataclass(frozen=True)
class Integers:
    """A non-empty list of whole numbers, each within bounds; held as a tuple."""

    about: str
    bounds: Bounds = Bounds()

    def accept(self, value: Any) -> tuple[int, ...]:
        if not isinstance(value, (list, tuple)) or not value:
            raise ValueError
        return tuple(Integer(self.about, self.bounds).accept(entry) for entry in value)

    @property
    def allowed(self) -> str:
        return f"a list such as [16, 16] of whole numbers, each {self.bounds}".removesuffix(", each ")


@dataclass(frozen=True)
class Boolean:
    """True or false."""

    about: str

    def accept(self, value: Any) -> bool:
        if not isinstance(value, bool):
            raise ValueError
        return value

    @property
    def allowed(self) -> str:
        return "true or false"


@dataclass(frozen=True)
class Choice:
    """One of a few words; with `paths` also an import path, which has a colon."""

    about: str
    words: tuple[str, ...] = ()
    paths: bool = False

    def accept(self, value: Any) -> str:
        if not isinstance(value, str):
            raise ValueError
        if value not in self.words and not (self.paths and ":" in value):
            raise ValueError(nearest(value, self.words))
        return value

    @property
    def allowed(self) -> str:
        return "one of " + ", ".join(map(quoted, self.words)) + (f", or {IMPORT_PATH}" if self.paths else "")


@dataclass(frozen=True)
class Text:
    """A non-empty string, or a path that is held as one."""

    about: str

    def accept(self, value: Any) -> str:
        if not isinstance(value, (str, os.PathLike)) or not os.fspath(value):
            raise ValueError
        return os.fspath(value)

    @property
    def allowed(self) -> str:
        return "a text in quotes"


@dataclass(frozen=True)
class Name(Text):
    """The name of a directory: letters, digits, ".", "_" and "-", the first a letter or a digit; 100 at most."""

    def accept(self, value: Any) -> str:
        name = super().accept(value)
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{,99}", name):
            raise ValueError('choose another, such as "my-run_2"')
        return name

    @property
    def allowed(self) -> str:
        return 'the name of a directory: at most 100 letters, digits, ".", "_" and "-", the first a letter or a digit'


@dataclass(frozen=True)
class Texts:
    """A list of non-empty strings, with `words` of these or, with `paths`, import paths; held as a tuple."""

    about: str
    words: tuple[str, ...] = ()
    paths: bool = False

    def accept(self, value: Any) -> tuple[str, ...]:
        if not isinstance(value, (list, tuple)):
            raise ValueError
        entry = Choice(self.about, self.words, self.paths) if self.words else Text(self.about)
        return tuple(map(entry.accept, value))

    @property
    def allowed(self) -> str:
        if not self.words:
            return 'a list of texts, such as ["one", "two"]'
        return "a list of any of " + ", ".join(map(quoted, self.words)) + (f", or {IMPORT_PATH}" if self.paths else "")


def nearest(given: str, valid: Iterable[str], cutoff: float = 0.6) -> str:
    """The hint "did you mean ...?" with the valid spelling that is nearest to what was given; empty if none is near."""
    near = difflib.get_close_matches(given, list(valid), n=1, cutoff=cutoff)
    return f"did you mean {near[0]}?" if near else ""


def shortened(text: str) -> str:
    """A text as an error shows it: its beginning, where it is long."""
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}... ({len(text)} characters)"


def quoted(value: Any) -> str:
    """The value as TOML writes it: strings in double quotes, tuples as lists, floats to full precision."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {quoted(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(quoted, value)) + "]"
    if isinstance(value, (bool, str)):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, int) and value.bit_length() > MOST_BITS:
        return hex(value)
    return repr(value) if isinstance(value, (int, float)) else str(value)
