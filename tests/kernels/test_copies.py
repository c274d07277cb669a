"""Compiled copies around transforms against those of numpy, for each instruction set that this processor runs."""

import numpy as np
import pytest

from eddies.kernels.copies import ColumnCopies, PlaneCopies
from tests.kernels import reference_copies

TOLERANCE = {np.complex128: 1e-14, np.complex64: 1e-6}
# Cells, cutoff, and how an axis is cut among ranks, of which some have nothing.
GRIDS = [(12, 3, (7,)), (13, 4, (5, 4)), (8, 2, (2, 2, 0, 1)), (7, 3, (4, 0, 3)), (4, 1, (1, 1, 1)), (3, 0, (1,))]
PLANES = [slice(0, 6), slice(2, 4), slice(6, 7), slice(0, 1)]


def noise(seed, dtype, *shape):
    random = np.random.default_rng(seed)
    return (random.standard_normal(shape) + 1j * random.standard_normal(shape)).astype(dtype)


def both(library, kind, cells, cutoff, dtype):
    definition, compiled = {"planes": (reference_copies.PlaneCopies, PlaneCopies),
                            "columns": (reference_copies.ColumnCopies, ColumnCopies)}[kind]
    return definition(cells, cutoff, dtype), compiled(library, cells, cutoff, dtype)


def plane_blocks(cutoff, cut, dtype):
    """Three components, seven planes, lines cut among ranks."""
    return [noise(rank, dtype, 3, 7, lines, cutoff + 1) for rank, lines in enumerate(cut)]


def assert_close(found, expected):
    assert found.shape == expected.shape and found.dtype == expected.dtype
    kind = expected.dtype.type if np.iscomplexobj(expected) else np.result_type(expected, np.complex64).type
    assert np.abs(found - expected).max(initial=0) <= TOLERANCE[kind] * np.abs(expected).max(initial=0)


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("planes", PLANES, ids=str)
@pytest.mark.parametrize("cells, cutoff, cut", GRIDS)
def test_planes_are_packed_and_unpacked_as_by_numpy(library, cells, cutoff, cut, planes, dtype):
    definition, compiled = both(library, "planes", cells, cutoff, dtype)
    blocks = plane_blocks(cutoff, cut, dtype)
    assert_close(compiled.pack(compiled.described_blocks(blocks), planes), definition.pack(blocks, planes))
    pairs = (planes.stop - planes.start + 1) // 2
    rows = noise(9, dtype, pairs, cells, min(cells, 2 * cutoff + 3))
    found, expected = plane_blocks(cutoff, cut, dtype), plane_blocks(cutoff, cut, dtype)
    compiled.unpack(compiled.described(rows), compiled.described_blocks(found), 1, planes)
    definition.unpack(rows, expected, 1, planes)
    for one, other in zip(found, expected):
        assert_close(one, other)


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("cells, cutoff, cut", GRIDS)
@pytest.mark.parametrize("along", ["none", "x", "y"])
def test_rows_are_filled_as_by_numpy_and_their_gap_is_left_alone(library, cells, cutoff, cut, along, dtype):
    modes, pairs = 2 * cutoff + 1, 3
    part = noise(3, dtype, 2, pairs, modes, modes)
    factors = {"none": None, "x": noise(4, dtype, 1, 1, 1, modes), "y": noise(4, dtype, 1, 1, modes, 1)}[along]
    filled = []
    for copies in both(library, "planes", cells, cutoff, dtype):
        rows = np.full((pairs, cells, min(cells, modes + 2)), 7, dtype)
        filled.append([rows.copy() for _ in copies.filled(part, factors, copies.described(rows))])
    assert len(filled[0]) == len(filled[1]) == 2
    for found, expected in zip(*filled[::-1]):
        assert_close(found, expected)


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("planes", PLANES, ids=str)
def test_planes_are_joined_and_split_as_by_numpy(library, planes, dtype):
    real, count = noise(5, dtype, 3, 7, 5, 5).real.copy(), planes.stop - planes.start
    for copies in both(library, "planes", 5, 1, dtype):
        joined, split = np.zeros(((count + 1) // 2, 5, 5), dtype), np.zeros_like(real)
        copies.join(copies.described(real), 1, planes, copies.described(joined))
        copies.split(copies.described(joined), copies.described(split), 1, planes)
        assert np.array_equal(split[1, planes], real[1, planes]) and np.count_nonzero(split) == count * 25
        f, g = real[1, planes][: len(joined)], real[1, planes][-len(joined) :]
        assert np.array_equal(joined.real, f) and np.array_equal(joined.imag, g)


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("cells, cutoff, cut", GRIDS)
@pytest.mark.parametrize("gap", [0, 3])
@pytest.mark.parametrize("rows", [slice(0, 1), slice(1, 4)], ids=str)
def test_columns_are_copied_as_by_numpy(library, cells, cutoff, cut, rows, gap, dtype):
    modes, width, lines = 2 * cutoff + 1, cutoff + 1, 4
    shape = (cells, rows.stop - rows.start, width)

    def column_of(memory):
        return memory[:, : memory.shape[1] - gap].reshape(shape)

    cut = (cells - sum(cut[1:]), *cut[1:])
    results = []
    for copies in both(library, "columns", cells, cutoff, dtype):
        blocks = [noise(rank, dtype, 3, planes, lines, width) for rank, planes in enumerate(cut)]
        memory, noisy = np.zeros((cells, shape[1] * width + gap), dtype), noise(9, dtype, cells, shape[1] * width + gap)
        column = column_of(memory)
        stored = noise(6, dtype, 2, modes, lines, width)
        described, place, made = copies.described_blocks(blocks), copies.described_column(column), []
        for factors in (None, copies.described(noise(7, dtype, modes))):
            copies.fill(copies.described(noise(8, dtype, 3, modes, lines, width)), 2, rows, factors, place)
            made.append(column.copy())
        copies.receive(described, 2, rows, place)
        copies.store(place, 0.3, copies.described(stored), 1, rows)
        copies.send(copies.described_column(column_of(noisy)), described, 1, rows)
        results.append([*made, memory, stored, *blocks])
    for found, expected in zip(*results[::-1]):
        assert_close(found, expected)


def test_arrays_of_another_kind_are_refused(library):
    planes, columns = (both(library, kind, 12, 3, np.complex128)[1] for kind in ("planes", "columns"))
    blocks = planes.described_blocks(plane_blocks(3, (7,), np.complex128))

    def array(*shape, dtype=np.complex128):
        return planes.described(noise(1, dtype, *shape))

    def column(*shape, dtype=np.complex128):
        return columns.described_column(noise(1, dtype, *shape))

    refused = {
        "are needed": [
            lambda: planes.described_blocks(plane_blocks(3, (7,), np.complex64)),
            lambda: planes.described(np.zeros((2, 3, 4))[..., ::2]),
            lambda: planes.unpack(array(1, 11, 9), blocks, 0, slice(0, 2)),
            lambda: planes.unpack(array(1, 12, 9, dtype=np.complex64), blocks, 0, slice(0, 2)),
            lambda: next(planes.filled(noise(1, np.complex128, 1, 1, 7, 6), None, array(1, 12, 9))),
            lambda: planes.join(array(1, 2, 12, 12), 0, slice(0, 2), array(1, 12, 12)),
            lambda: columns.described_column(np.zeros((2, 4, 4), np.complex128)[:, :, ::2]),
            lambda: columns.fill(array(1, 7, 4, 4), 0, slice(0, 3), array(6), column(12, 3, 4))],
        "is needed": [
            lambda: columns.fill(array(1, 7, 4, 4), 0, slice(0, 3), None, column(12, 2, 4)),
            lambda: columns.fill(array(1, 7, 4, 4), 0, slice(0, 3), None, column(12, 3, 4, dtype=np.complex64))],
        "an even number": [lambda: planes.pack(blocks, slice(0, 3))],
        "6 to 8 of 7": [lambda: planes.pack(blocks, slice(6, 8))],
        "3 to 4 of 3": [lambda: planes.unpack(array(1, 12, 9), blocks, 3, slice(0, 2))],
        "2 to 5 of 4": [lambda: columns.fill(array(1, 7, 4, 4), 0, slice(2, 5), None, column(12, 3, 4))],
        "1 to 2 of 1": [lambda: columns.store(column(12, 3, 4), 1.0, array(1, 7, 4, 4), 1, slice(0, 3))],
    }
    for message, calls in refused.items():
        for call in calls:
            with pytest.raises(ValueError, match=message):
                call()
