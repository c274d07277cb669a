"""Frames are indexed as numpy does, and only those in use are read."""

import numpy as np
import pytest

from eddies.io.datasets import Frames, open_group
from eddies.io.errors import ProductError
from eddies.io.fields import FieldWriter
from eddies.io.hdf5 import create_product

VALUES = np.random.default_rng(1).random((6, 4, 3))


@pytest.mark.parametrize("key, used", [
    ((-1, slice(None), 2, ...), [5]), ((slice(4, None, -2), slice(1, None), slice(None), ...), [4, 2, 0]),
    ((slice(2, 2), np.array([1]), slice(None)), []), ((np.array([3, 0, 3]), slice(None), slice(None)), [3, 0, 3]),
    ((slice(None, None, -3), np.array([3, 0, 0]), slice(None)), [5, 2]),
    ((np.array([[[4]], [[1]]]), np.array([[3], [0]]), np.array([2, 0])), [1, 4]),
    ((slice(3, 1, -1), np.array([3, 0]), np.array([1, 1])), [3, 2]),
    ((np.array([[2, 0], [0, 0]]), slice(None), slice(None)), [0, 2])])
def test_a_part_is_that_of_numpy(key, used):
    read = []
    frames = Frames(VALUES.shape, VALUES.dtype, lambda numbers: (read.append(n) or VALUES[n, None] for n in numbers))
    part = frames[key]
    assert np.array_equal(part, VALUES[key]) and part.shape == VALUES[key].shape and read == used


@pytest.mark.mpi(1)
def test_quantities_with_different_numbers_of_components(comm, tmp_path):
    """A scalar has no axis of components, and nine components have an axis of their own."""
    counts = {"velocity": 3, "gradient": 9, "pressure": 1}
    fields = {name: np.random.default_rng(2).random((count, 4, 4, 4)) for name, count in counts.items()}
    with create_product(comm, tmp_path / "r.h5", "reconstruction", {}) as file:
        FieldWriter(file, "reconstructed", 4, counts).append(0.5, 0, fields)
    found = open_group(tmp_path / "r.h5", "fields/reconstructed").isel(time=0)
    grid = ("z", "y", "x")
    assert {name: found[name].dims for name in counts} == {
        "velocity": ("component", *grid), "gradient": ("gradient_component", *grid), "pressure": grid}
    for name, values in fields.items():
        assert np.array_equal(found[name], values.astype(np.float32).reshape(found[name].shape))
    assert found["gradient"].attrs == {"units": "1/T"} and found["x"].attrs == {"units": "L"}
    with pytest.raises(ProductError, match="r.h5: holds no fields; it holds: fields/reconstructed"):
        open_group(tmp_path / "r.h5", "fields")
