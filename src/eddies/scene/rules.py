"""The rule of a key: its meaning and its allowed values. Also functions that write values in errors and files."""

import dataclasses
import difflib
import json
import math
import numbers
import os
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

IMPORT_PATH = 'the import path "module:name" of your own class or function'
# Smallest and largest magnitude of a real number, and largest whole number. Beyond them squares and cubes overflow, or
# a run does not end.
SMALLEST, LARGEST, MOST = 1e-15, 1e15, 10**9
# Largest number of characters of a value in an error, and of bits of a whole number that is written in decimal.
SHOWN, MOST_BITS = 60, 10_000


@dataclass(frozen=True)
class Bounds:
    """The interval of allowed numbers. `above` and `below` exclude its ends, `at_least` and `at_most` include them."""

    above: float = -math.inf
    at_least: float = -math.inf
    below: float = math.inf
    at_most: float = math.inf

    def __contains__(self, number: Any) -> bool:
        return self.above < number < self.below and self.at_least <= number <= self.at_most

    @property
    def given(self) -> dict[str, float]:
        """The bounds that are set, by name."""
        return {name: bound for name, bound in dataclasses.asdict(self).items() if math.isfinite(bound)}

    def __str__(self) -> str:
        return " and ".join(f"{name.replace('_', ' ')} {bound:g}" for name, bound in self.given.items())


@dataclass(frozen=True)
class Rule:
    """The meaning of a key and the values that it may have.

    Parameters
    ----------
    kind : type of the value, or of each entry of a list: float, int, bool or str.
    about : meaning of the key in one line.
    bounds : interval of the allowed numbers.
    words : allowed strings. If `kind` is a number, they are allowed besides numbers, or in place of a list of numbers.
        If `kind` is str and there are no words, any string is allowed.
    paths : whether the import path "module:name" of a user's own class is allowed too.
    many : whether the value is a list, held as a tuple.
    numbered : whether a whole number from 1 on is allowed besides strings.
    """

    kind: type
    about: str = ""
    bounds: Bounds = Bounds()
    words: tuple[str, ...] = ()
    paths: bool = False
    many: bool = False
    numbered: bool = False

    def accept(self, value: Any) -> Any:
        """Return the value in the form in which a section holds it.

        Raises ValueError, whose text is a hint or empty, if the value is not allowed.
        """
        if not self.many or self.kind is not str and isinstance(value, str) and value in self.words:
            return self._accept_one(value)
        if not isinstance(value, (list, tuple)) or self.kind is int and not value:
            raise ValueError
        return tuple(self._accept_one(entry) for entry in value)

    @property
    def allowed(self) -> str:
        """The allowed values in words, for errors."""
        words = [quoted(word) for word in self.words]
        if self.kind is bool:
            return "true or false"
        if self.numbered:
            return "a string in quotes, or a whole number at least 1"
        if self.kind is str and not words:
            return 'a list of strings, such as ["one", "two"]' if self.many else "a string in quotes"
        if self.kind is str:
            return ("a list of any of " if self.many else "one of ") + ", ".join(words) + (
                f", or {IMPORT_PATH}" if self.paths else "")
        if self.many:
            entries = "[16, 16] of whole numbers" if self.kind is int else "[0.5, 1.5] of numbers"
            return " or ".join([f"a list such as {entries}, each {self.bounds}".removesuffix(", each "), *words])
        noun = "a whole number" if self.kind is int else "a number"
        return " or ".join([f"{noun} {self.bounds}".rstrip(), *words])

    def _accept_one(self, value: Any) -> Any:
        if self.numbered and isinstance(value, int) and not isinstance(value, bool) and value >= 1:
            return value
        if self.kind is str:
            return self._accept_text(value)
        if isinstance(value, bool) != (self.kind is bool):
            raise ValueError
        if self.kind is bool or isinstance(value, str) and value in self.words:
            return value
        return self._accept_number(value)

    def _accept_text(self, value: Any) -> str:
        if self.words:
            if not isinstance(value, str):
                raise ValueError
            if value not in self.words and not (self.paths and ":" in value):
                raise ValueError(nearest(value, self.words).rstrip())
            return value
        if not isinstance(value, (str, os.PathLike)) or not os.fspath(value):
            raise ValueError
        try:
            os.fspath(value).encode()
        except UnicodeEncodeError:  # from the name of a file or directory
            raise ValueError("a scene is text in UTF-8, but this is not; rename the file or directory") from None
        return os.fspath(value)

    def _accept_number(self, value: Any) -> float | int:
        is_number = isinstance(value, numbers.Integral if self.kind is int else numbers.Real)
        if not is_number or value not in self.bounds:
            raise ValueError
        if self.kind is int:
            if abs(int(value)) > MOST and self.bounds.at_most == math.inf:
                raise ValueError(f"whole numbers of a scene are at most {MOST:,}")
            return int(value)
        if value != 0 and not SMALLEST <= abs(value) <= LARGEST:
            raise ValueError(f"the magnitude of a number is 0, or between {SMALLEST:g} and {LARGEST:g}")
        return float(value)


def nearest(given: str, valid: Iterable[str], cutoff: float = 0.6) -> str:
    """Return the hint "did you mean ...? " with the nearest valid spelling; empty if none is near.

    `cutoff` is the smallest similarity of a near spelling, from 0 to 1.
    """
    near = difflib.get_close_matches(given, list(valid), n=1, cutoff=cutoff)
    return f"did you mean {near[0]}? " if near else ""


def shortened(text: str) -> str:
    """Return a text for an error, cut off if it is long."""
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}... ({len(text)} characters)"


def quoted(value: Any) -> str:
    """Return the value as TOML writes it: strings in double quotes, tuples as lists, floats to full precision."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {quoted(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(quoted, value)) + "]"
    if isinstance(value, (bool, str)):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, int) and value.bit_length() > MOST_BITS:
        return hex(value)
    return repr(value) if isinstance(value, (int, float)) else str(value)
