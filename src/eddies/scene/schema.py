"""The JSON schema of scenes, made from the declarations of their keys. Editors use it to complete and check the files
of scenes."""

import dataclasses
from typing import Any

from eddies.scene.layers import VARIANT
from eddies.scene.model import Model
from eddies.scene.rules import Rule
from eddies.scene.scene import Scene
from eddies.scene.terms import TERMS
from eddies.scene.values import ABSENT, Section, rule_of

TYPES = {float: "number", int: "integer", bool: "boolean", str: "string"}
LIMITS = {"above": "exclusiveMinimum", "at_least": "minimum", "below": "exclusiveMaximum", "at_most": "maximum"}


def json_schema() -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of a scene file.

    The schema requires no key, because the base of a scene may give any key. In a section [model.NAME] of a user's own
    term it accepts all keys.
    """
    schema = _object(Scene)
    schema["properties"] |= {
        "base": {"type": "string", "description": "name or path of the scene that this one starts from"},
        "unset": {"type": "array", "items": {"type": "string"}, "description": "removed keys of the base"},
        VARIANT: {"type": "object", "additionalProperties": {"$ref": "#"}, "description": "changed keys by variant"}}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "scene of eddies"} | schema


def _object(kind: type[Section]) -> dict[str, Any]:
    """Return the schema of a section."""
    properties = {}
    for field in dataclasses.fields(kind):
        rule, inner = rule_of(kind, field), field.metadata.get("section")
        if inner is not None:
            properties[field.name] = _object(inner)
        elif rule is not None:
            properties[field.name] = _value(rule, field.default)
    if kind is Model:
        properties |= {word: _object(settings) for word, settings in TERMS.items()}
    return {"type": "object", "description": str(kind.__doc__).splitlines()[0], "properties": properties,
            "additionalProperties": {"type": "object"} if kind._holder else False}


def _value(rule: Rule, default: Any) -> dict[str, Any]:
    """Return the schema of one key."""
    choices: list[dict[str, Any]] = [{"enum": [*rule.words]}] if rule.words else []
    if rule.paths:
        choices.append({"type": "string", "pattern": ":"})
    if rule.kind is not str or not rule.words:
        limits = {LIMITS[name]: bound for name, bound in rule.bounds.given.items()}
        choices.append({"type": TYPES[rule.kind]} | limits)
    if rule.many:
        choices = [{"type": "array", "items": choices[0] if len(choices) == 1 else {"anyOf": choices}}]
    if default is None:
        choices.append({"const": ABSENT})
    given = {"default": default} if default not in (None, dataclasses.MISSING) else {}
    return (choices[0] if len(choices) == 1 else {"anyOf": choices}) | {"description": rule.about} | given
