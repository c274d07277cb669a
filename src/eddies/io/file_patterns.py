"""Files of a series, named by a path in which * stands for any text."""

import glob
import os
import re
from collections.abc import Sequence
from pathlib import Path


FileVersion = tuple[Path, int, int]


def matching_files(path: str | Path) -> list[Path]:
    """Return the files that a path names, in the order of the numbers in their paths; an empty list if there are none.

    In the path * stands for any text. All other characters stand for themselves.
    """
    pattern = glob.escape(str(path)).replace("[*]", "*")
    found = [file for file in map(Path, glob.glob(pattern)) if file.is_file()]
    return sorted(found, key=lambda file: [int(part) if part.isdecimal() else part
                                           for part in re.split(r"(\d+)", str(file))])


def short_names(files: Sequence[Path]) -> list[str]:
    """Return the paths of files relative to the folder that holds all of them."""
    folder = os.path.commonpath([file.parent for file in files])
    return [str(file.relative_to(folder)) for file in files]


def file_versions(path: str | Path) -> tuple[FileVersion, ...]:
    """Return path, size and time of change of each file that a path names. They change if a content changes."""
    states = [(file, file.stat()) for file in matching_files(path)]
    return tuple((file, state.st_size, state.st_mtime_ns) for file, state in states)
