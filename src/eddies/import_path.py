"""Import paths "module:name": classes and functions of the user's, where a word names one of this package.

A path is imported where a scene or a program that the user runs names it, and nowhere else: never because a file does.
"""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Iterable
from importlib import import_module, metadata
from pathlib import Path
from typing import Any

from eddies.errors import UserError


class ImportPathError(UserError, ValueError):
    """An import path leads nowhere."""


def is_path(name: str) -> bool:
    """Whether a name is an import path, not a word."""
    return ":" in name


def short_name(name: str) -> str:
    """What a thing goes by in sections and logs: the word, or what follows the colon of an import path."""
    return name.rpartition(":")[2]


def search_in(folder: str | Path) -> None:
    """Look for modules of import paths in a folder too, after all other places."""
    folder = str(Path(folder).resolve())
    if folder not in sys.path:
        sys.path.append(folder)


def load(path: str) -> Any:
    """What an import path "module:name" names.

    Raises ImportPathError: it is not of this form, there is no such module or name, or the module raises while it is
    imported.
    """
    module_name, _, name = path.partition(":")
    if not module_name or not name.isidentifier():
        raise ImportPathError(f'"{path}": an import path is "module:name", such as "mypackage.les:MyTerm"')
    try:
        module = import_module(module_name)
    except ModuleNotFoundError as error:
        missing = f'there is no module "{error.name}"' + ("" if error.name == module_name else ", which it imports")
        raise ImportPathError(f'"{path}": {missing}; put it beside the scene, into the working directory, or '
                              "into a folder of PYTHONPATH") from None
    except Exception as error:
        raise ImportPathError(f'"{path}": importing {module_name} fails: {type(error).__name__}: {error}') from error
    if not hasattr(module, name):
        raise ImportPathError(f'"{path}": {module_name} has no {name}')
    return getattr(module, name)


def origins(paths: Iterable[str]) -> dict[str, dict[str, str | None]]:
    """The version of each import path's package, if it is an installed one, and the SHA-256 of its source."""
    return {path: _origin(path) for path in sorted(set(paths))}


def _origin(path: str) -> dict[str, str | None]:
    source = inspect.getsourcefile(sys.modules[load(path).__module__])
    digest = hashlib.sha256(Path(source).read_bytes()).hexdigest() if source else None
    try:
        version = metadata.version(path.partition(":")[0].partition(".")[0])
    except metadata.PackageNotFoundError:
        version = None
    return {"version": version, "sha256": digest}
