"""Turns a TOML document and the user's `--set` overrides into checked dataclasses.

Nothing here knows a particular section or key: what is allowed stands beside the fields of the dataclasses
(`scene_values`).
"""

import dataclasses
import difflib
import tomllib
from dataclasses import MISSING
from pathlib import Path
from typing import Any

from eddies.scene_values import SceneError, quoted


def find_document(name_or_path: str, built_in: Path, what: str) -> Path:
    """The file of a built-in name (a TOML file in the folder `built_in`), or of a path; SceneError lists the names."""
    names = sorted(path.stem for path in built_in.glob("*.toml"))
    if name_or_path in names:
        return built_in / f"{name_or_path}.toml"
    if Path(name_or_path).is_file():
        return Path(name_or_path)
    near = difflib.get_close_matches(name_or_path, names, n=1)
    advice = f"did you mean {near[0]}? " if near else ""
    raise SceneError(f"{name_or_path}: no such {what}; {advice}give the path of a TOML file, or one of "
                     f"{', '.join(names)}")


def parse_document(text: str) -> dict[str, Any]:
    """The tables and keys of a TOML text.

    Raises:
        SceneError: with the line at which the text stops being TOML.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SceneError(f"not TOML: {error}; keys are written `key = value` under a [section]") from None


def read_text(path: Path) -> str:
    """The text of a scene file; SceneError if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise SceneError(f"cannot be read: {reason}; give the path of a scene, a TOML file") from None


def apply_overrides(document: dict[str, Any], overrides: list[str]) -> set[str]:
    """Write each "section.key=value" (or "key=value") over the document; returns the keys written.

    The value is read as TOML; what is not TOML, such as a bare word, is a string. A section that the document
    lacks is made.
    """
    keys = set()
    for override in overrides:
        path, equals, value = (part.strip() for part in override.partition("="))
        names = path.split(".")
        if not equals or not value or len(names) > 2 or not all(names):
            raise SceneError(f"--set {override}: must be section.key=value, or key=value outside sections")
        table = document
        if len(names) == 2:
            table = document.setdefault(names[0], {})
            if not isinstance(table, dict):
                raise SceneError(f"--set {override}: {names[0]} is a value, not a section")
        table[names[-1]] = _override_value(value)
        keys.add(path)
    return keys


def read_section(kind: type, table: Any, name: str = "") -> Any:
    """The dataclass `kind` filled from a TOML table; `name` is the section's, empty for the whole document.

    Raises:
        SceneError: for an unknown key, a value that its declaration refuses, or a key that is missing.
    """
    if not isinstance(table, dict):
        message = f"{name} = {quoted(table)}: must be a section; write [{name}] and its keys below"
        raise SceneError(message, name)
    fields = {field.name: field for field in dataclasses.fields(kind)}
    for key in table:
        if key not in fields:
            raise _unknown(key, table[key], name, fields)
    values = {key: _read_value(fields[key], value, name) for key, value in table.items()}
    for key, field in fields.items():
        if key not in values and field.default is MISSING:
            raise _missing(field, name)
    return kind(**values)


def write_section(section: Any) -> list[str]:
    """The lines `key = value  # meaning` of a section; keys that are None are left out."""
    lines = []
    for field in dataclasses.fields(section):
        value = getattr(section, field.name)
        if "rule" in field.metadata and value is not None:
            lines.append(f"{field.name} = {quoted(value)}  # {field.metadata['rule'].about}")
    return lines


def _override_value(value: str) -> Any:
    try:
        parsed = tomllib.loads(f"value = {value}")
    except tomllib.TOMLDecodeError:
        return value
    return parsed["value"] if len(parsed) == 1 else value


def _read_value(field: dataclasses.Field, value: Any, section: str) -> Any:
    if "section" in field.metadata:
        return read_section(field.metadata["section"], value, field.name)
    if "sections" in field.metadata:
        return _read_sections(field.metadata["sections"], value, field.name)
    rule = field.metadata["rule"]
    try:
        return rule.accept(value)
    except ValueError:
        where = _where(field.name, section)
        message = f"{where} = {quoted(value)}: must be {rule.allowed} ({rule.about})"
        raise SceneError(message, _path(field.name, section)) from None


def _read_sections(kind: type, tables: Any, name: str) -> tuple:
    """A dataclass for each [[name]]; an error says which by its number, and by its name if it has one."""
    if not isinstance(tables, list):
        raise SceneError(f"{name} = {quoted(tables)}: must be sections; write [[{name}]] before each", name)
    read = []
    for number, table in enumerate(tables, 1):
        try:
            read.append(read_section(kind, table, name))
        except SceneError as error:
            own = f' ("{table["name"]}")' if isinstance(table, dict) and "name" in table else ""
            raise SceneError(f"[[{name}]] number {number}{own}: {error}", error.key) from None
    return tuple(read)


def _unknown(key: str, value: Any, section: str, fields: dict[str, dataclasses.Field]) -> SceneError:
    near = difflib.get_close_matches(key, fields, n=1, cutoff=0.5)
    advice = f"did you mean {near[0]}? " if near else ""
    what = "section" if isinstance(value, dict) and not section else "key"
    where = f"[{key}]" if what == "section" else _where(key, section)
    valid = ", ".join(fields)
    return SceneError(f"{where}: no such {what}; {advice}valid here: {valid}", _path(key, section))


def _missing(field: dataclasses.Field, section: str) -> SceneError:
    if "section" in field.metadata:
        return SceneError(f"[{field.name}]: this section is missing; every scene needs it", field.name)
    rule = field.metadata["rule"]
    message = f"{_where(field.name, section)}: this key is missing ({rule.about}); give it {rule.allowed}"
    return SceneError(message, _path(field.name, section))


def _where(key: str, section: str) -> str:
    return f"[{section}] {key}" if section else key


def _path(key: str, section: str) -> str:
    return f"{section}.{key}" if section else key
