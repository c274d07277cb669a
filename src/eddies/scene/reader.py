"""Turns a TOML document into sections, and sections into TOML.

Nothing here knows a particular section or key: what is allowed stands beside the fields of the dataclasses
(`scene/values.py`), which check their values themselves.
"""

import dataclasses
import tomllib
from collections.abc import Sequence
from dataclasses import MISSING
from pathlib import Path
from typing import Any

from eddies.scene.rules import nearest, quoted, shortened
from eddies.scene.values import KeyProblem, SceneError, Section, rule_of


def find_document(name_or_path: str, built_in: Path, beside: Path | None = None) -> Path:
    """The file of a built-in scene (a TOML file in the folder `built_in`), or of a path, from the folder `beside` or
    else from the working directory; SceneError lists the names."""
    names = sorted(path.stem for path in built_in.glob("*.toml"))
    if name_or_path in names:
        return built_in / f"{name_or_path}.toml"
    path = Path(name_or_path)
    try:
        if beside is not None and (beside / path).is_file():
            return beside / path
        if path.is_file():
            return path
        is_directory = path.is_dir()
    except OSError as error:
        raise SceneError(f"{shortened(name_or_path)}: cannot be read: {error.strerror}; give the path of a TOML "
                         f"file, or one of {', '.join(names)}") from None
    if is_directory:
        raise SceneError(f"{name_or_path}: is a directory, not a scene; give the path of a TOML file in it")
    hint = f"{nearest(name_or_path, names)} ".lstrip()
    raise SceneError(f"{shortened(name_or_path)}: no such scene; {hint}give the path of a TOML file, or one of "
                     f"{', '.join(names)}")


def parse_document(text: str) -> dict[str, Any]:
    """The tables and keys of a TOML text.

    Raises:
        SceneError: with the line at which the text stops being TOML.
    """
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise SceneError("not TOML of a scene: its brackets are nested too deep; no value has more than two") from None
    except ValueError as error:  # of TOML, or of a number with thousands of digits
        raise SceneError(f"not TOML: {error}; keys are written `key = value` under a [section]") from None


def read_text(path: Path) -> str:
    """The text of a scene file; SceneError if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8-sig")  # some editors begin a file with a mark of its encoding
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise SceneError(f"cannot be read: {reason}; give the path of a scene, a TOML file") from None


def read_section(kind: type[Section], table: Any, name: str = "") -> Any:
    """The dataclass `kind` filled from a TOML table; `name` is the section's, empty for the whole document.

    Raises:
        SceneError: for an unknown key, a value that its declaration refuses, or a key that is missing.
    """
    if not isinstance(table, dict):
        message = f"{name} = {shortened(quoted(table))}: must be a section; write [{name}] and its keys below"
        raise SceneError(message, name)
    every = {field.name: field for field in dataclasses.fields(kind)}
    fields = {key: field for key, field in every.items() if not field.metadata.keys() & {"sub_sections", "scenes"}}
    holder = next((key for key, field in every.items() if "sub_sections" in field.metadata), None)
    values, inner = {}, {}
    for key, value in table.items():
        if key in fields:
            values[key] = _read_value(fields[key], value, _within(name, key))
        elif holder and isinstance(value, dict):
            inner[key] = value
        else:
            raise _unknown(key, value, name, [*fields, *kind.of_the_file])
    for key, field in fields.items():
        if key not in values and field.default is field.default_factory is MISSING:
            raise _missing(kind, field, name)
    try:
        return kind(**values, **({holder: inner} if inner else {}))
    except KeyProblem as problem:
        raise (problem.within(name) if problem.section == kind.section_name() else problem) from None


def write_section(section: Section, name: str = "") -> list[str]:
    """The lines `key = value  # meaning` of a section, and below them those of its own sections; keys and sections that
    are None are left out, and sections of terms that have no keys."""
    lines, inner = [], []
    for field in dataclasses.fields(section):
        value, rule = getattr(section, field.name), rule_of(type(section), field)
        if "section" in field.metadata and value is not None:
            own = _within(name, field.name)
            inner += ["", f"[{own}]", *write_section(value, own)]
        elif "sub_sections" in field.metadata:
            for key, part in value.items():
                if written := write_section(part):
                    inner += ["", f"[{name}.{key}]", *written]
        elif rule is not None and value is not None:
            lines.append(f"{field.name} = {quoted(value)}" + (f"  # {rule.about}" if rule.about else ""))
    return lines + inner


def _within(section: str, name: str) -> str:
    """The name of a section's own section."""
    return f"{section}.{name}" if section else name


def _read_value(field: dataclasses.Field, value: Any, name: str) -> Any:
    if "section" in field.metadata:
        return read_section(field.metadata["section"], value, name)
    return value


def _unknown(key: str, value: Any, section: str, valid: Sequence[str]) -> SceneError:
    hint = f"{nearest(key, valid, cutoff=0.5)} ".lstrip()
    is_section = isinstance(value, dict) and not section
    known = ", ".join(valid) or "no key; remove it"
    problem = f": no such {'section' if is_section else 'key'}; {hint}valid here: {known}"
    return SceneError(f"[{key}]{problem}", key) if is_section else KeyProblem(section, key, problem)


def _missing(kind: type[Section], field: dataclasses.Field, section: str) -> SceneError:
    rule = rule_of(kind, field)
    if rule is None:
        return SceneError(f"[{field.name}]: this section is missing; every scene needs it", field.name)
    about = f" ({rule.about})" if rule.about else ""
    return KeyProblem(section, field.name, f": this key is missing{about}; give it {rule.allowed}")
