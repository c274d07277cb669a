"""The numbers that a product holds, one place after the other."""

from collections.abc import Iterator

import h5py
import numpy as np

FRAMES = "particles/", "fields/"  # groups of series, of which only the last frame is read


def stored_numbers(file: h5py.File) -> Iterator[tuple[str, int | None, np.ndarray]]:
    """Place, frame and values of all that an open product holds in floating point: attributes and tables, frame None,
    and the last frame of trajectories and fields."""
    names: list[str] = []
    file.visit(names.append)
    for name in names:
        found = file[name]
        for attribute, value in found.attrs.items():
            if np.asarray(value).dtype.kind == "f":
                yield f"{name}, attribute {attribute}", None, np.asarray(value)
        if isinstance(found, h5py.Dataset) and found.dtype.kind == "f" and found.size:
            if name.startswith(FRAMES) and found.maxshape[0] is None:
                yield name, len(found) - 1, found[-1]
            else:
                yield name, None, found[()]
