"""Small files that are written whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from eddies.io.errors import NoRoom


def write_files(contents: Mapping[Path, bytes | str]) -> None:
    """Write files, in place of those of the same names, once all could be written; one rank calls it.

    Raises OSError, which knows the bytes of all files: those that were there are as they were.
    """
    partials = {path: path.with_name(path.name + ".partial") for path in contents}
    whole = {path: content.encode() if isinstance(content, str) else content for path, content in contents.items()}
    path = Path()
    try:
        for path, partial in partials.items():
            partial.write_bytes(whole[path])
        for path, partial in partials.items():
            os.replace(partial, path)
    except OSError as error:
        raise NoRoom.of(error, path, sum(map(len, whole.values()))) from None
    finally:
        for partial in partials.values():
            if partial.is_file():
                partial.unlink()
