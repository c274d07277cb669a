"""Import paths "module:name" of a user's own classes and functions.

A path is imported only if a scene or a program of the user names it, never because a stored file names it.
"""

import hashlib
import inspect
import sys
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib import import_module, metadata
from pathlib import Path
from typing import Any

from eddies.errors import UserError


class ImportPathError(UserError, ValueError):
    """The object of an import path cannot be imported."""


def is_path(name: str) -> bool:
    """Return whether a name is an import path, not a built-in name."""
    return ":" in name


def short_name(name: str) -> str:
    """Return the name that scene sections and logs use: a built-in name, or the part of a path after the colon."""
    return name.rpartition(":")[2]


def search_in(folder: str | Path) -> None:
    """Let import paths find modules in this folder too. Python searches the folder after all others."""
    folder = str(Path(folder).resolve())
    if folder not in sys.path:
        sys.path.append(folder)


def load(path: str) -> Any:
    """Import and return the object that an import path names.

    Raises ImportPathError if the form is wrong, the module or name is missing, or the import raises an exception.
    """
    module_name, _, name = path.partition(":")
    if not module_name or not name.isidentifier():
        raise ImportPathError(f'"{path}": an import path is "module:name", such as "mypackage.les:MyTerm"')
    try:
        module = import_module(module_name)
    except ModuleNotFoundError as error:
        importer = "" if error.name == module_name else ", which it imports"
        raise ImportPathError(f'"{path}": there is no module "{error.name}"{importer}; put it beside the scene, into '
                              "the working directory, or into a folder of PYTHONPATH") from None
    except (Exception, SystemExit) as error:  # a user's code may raise anything
        raise ImportPathError(f'"{path}": importing {module_name} fails: {type(error).__name__}: {error}') from error
    if not hasattr(module, name):
        raise ImportPathError(f'"{path}": {module_name} has no {name}')
    return getattr(module, name)


@contextmanager
def users_code(called: Any, problem: type[UserError], hint: str = "") -> Iterator[None]:
    """Context that converts an exception of `called`, a user's class or function, into an error of type `problem`.

    The text of the error names `called` and, if known, the file and the line; it ends with `hint`. A UserError or a
    MemoryError passes unchanged. All exceptions pass unchanged if `called` belongs to this package. An exception whose
    class belongs to this package also passes unchanged.
    """
    try:
        yield
    except (UserError, MemoryError):
        raise
    except (Exception, SystemExit) as error:
        module = getattr(called, "__module__", None) or "builtins"
        kind = type(error).__module__
        if __package__ in (module.partition(".")[0], kind.partition(".")[0]):
            raise
        file = getattr(sys.modules.get(module), "__file__", None)
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
        place = f"{file}, line {lines[-1]}: " if lines else ""
        name = getattr(called, "__qualname__", type(called).__name__)
        raise problem(f"{name}: {place}{type(error).__name__}: {error}{hint}") from error


def origins(paths: Iterable[str]) -> dict[str, dict[str, str | None]]:
    """Return, for each import path, a table with the `version` of its package and the `sha256` of its source file.

    The version is None if the package is not installed. The SHA-256 is None if there is no source file.
    """
    return {path: {"version": _version(path), "sha256": _source_digest(path)} for path in sorted(set(paths))}


def _version(path: str) -> str | None:
    try:
        return metadata.version(path.partition(":")[0].partition(".")[0])
    except metadata.PackageNotFoundError:
        return None


def _source_digest(path: str) -> str | None:
    module = sys.modules[getattr(load(path), "__module__", None) or "builtins"]
    source = inspect.getsourcefile(module) if hasattr(module, "__file__") else None  # built-in modules have none
    return hashlib.sha256(Path(source).read_bytes()).hexdigest() if source else None
