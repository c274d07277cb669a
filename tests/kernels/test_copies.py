"""Copies around transforms: with numpy's transforms between them they transform real fields."""

import numpy as np
import pytest

from eddies.kernels.copies import ColumnCopies, PlaneCopies

TOLERANCE = {np.complex128: 1e-13, np.complex64: 1e-5}
# Cells, cutoff, the lines of each rank, of which some have none, and precision.
GRIDS = pytest.mark.parametrize("cells, cutoff, cut, dtype", [
    (12, 3, (7,), np.complex128), (13, 4, (5, 4), np.complex64), (8, 2, (2, 2, 0, 1), np.complex128),
    (7, 3, (4, 0, 3), np.complex64), (4, 1, (1, 1, 1), np.complex128), (3, 0, (1,), np.complex64)])
PLANES = [slice(0, 6), slice(2, 4), slice(6, 7)]


def noise(seed, dtype, *shape):
    random = np.random.default_rng(seed)
    return (random.standard_normal(shape) + 1j * random.standard_normal(shape)).astype(dtype)


def kept(size, cutoff):
    """Indices of the modes 0 ... K, -K ... -1 along an axis."""
    return np.r_[0:cutoff + 1, size - cutoff:size]


@GRIDS
def test_two_real_planes_are_transformed_as_one_complex_plane(library, close, cells, cutoff, cut, dtype):
    """The real planes f and g are half a block apart; the complex plane is f + i g."""
    copies, modes = PlaneCopies(library, cells, cutoff, dtype), 2 * cutoff + 1
    corner = np.ix_(kept(cells, cutoff), range(cutoff + 1))
    for planes in PLANES:
        count, real = planes.stop - planes.start, noise(1, dtype, 3, 7, cells, cells).real.copy()
        pairs = (count + 1) // 2
        blocks = [np.zeros((3, 7, lines, cutoff + 1), dtype) for lines in cut]
        described = copies.described_blocks(blocks)
        joined, split = np.zeros((pairs, cells, cells), dtype), np.zeros_like(real)
        transformed = [np.fft.rfft2(plane)[corner] for plane in real[1, planes]]
        copies.join(copies.described(real), 1, planes, copies.described(joined))
        width = kept(cells, min((cells - 1) // 2, cutoff + 1))
        rows = np.ascontiguousarray(np.fft.fft2(joined)[..., width], dtype)
        copies.unpack(copies.described(rows), described, 1, planes)
        found = np.concatenate(blocks, axis=2)
        close(found[1, planes], 2 * np.array(transformed), TOLERANCE[dtype])
        assert not found[[0, 2]].any() and np.count_nonzero(found[1].any(axis=(1, 2))) == count

        spread = np.zeros((pairs, cells, cells), complex)
        spread[:, kept(cells, cutoff)[:, None], kept(cells, cutoff)] = copies.pack(described, planes)[1]
        assert copies.pack(described, planes).shape == (3, pairs, modes, modes)
        joined[...] = np.fft.ifft2(spread)
        copies.split(copies.described(joined), copies.described(split), 1, planes)
        filtered = np.zeros((count, cells, cells // 2 + 1), complex)
        filtered[:, corner[0], corner[1]] = transformed
        close(split[1, planes], 2 * np.fft.irfft2(filtered, (cells, cells)), TOLERANCE[dtype])
        assert np.count_nonzero(split.any(axis=(2, 3))) == count


def test_modes_that_are_not_conjugate_by_round_off_are_averaged(library):
    """Otherwise f would leak into g."""
    copies, block = PlaneCopies(library, 8, 2, np.complex128), np.zeros((1, 2, 5, 3), complex)
    block[0, 0, 1, 0], block[0, 0, 4, 0] = 1 + 2j, 1.5 - 1j  # ky = 1 and -1 at kx = 0
    packed = copies.pack(copies.described_blocks([block]), slice(0, 2))[0, 0]
    assert packed[1, 0] == 1.25 + 1.5j and packed[4, 0] == 1.25 - 1.5j


@GRIDS
def test_rows_are_filled_and_their_gap_stays(library, close, cells, cutoff, cut, dtype):
    copies, modes = PlaneCopies(library, cells, cutoff, dtype), 2 * cutoff + 1
    part, width = noise(3, dtype, 2, 3, modes, modes), min(cells, modes + 2)
    place = np.ix_(range(3), kept(cells, cutoff), kept(width, cutoff))
    for factors in (None, noise(4, dtype, 1, 1, 1, modes), noise(4, dtype, 1, 1, modes, 1)):
        rows = np.full((3, cells, width), 7, dtype)
        filled = [rows.copy() for _ in copies.filled(part, factors, copies.described(rows))]
        for found, given in zip(filled, part if factors is None else part * factors, strict=True):
            expected = np.full_like(rows, 7)
            expected[place] = given
            close(found, expected, TOLERANCE[dtype])


@GRIDS
def test_columns_are_copied(library, close, cells, cutoff, cut, dtype):
    copies, modes, width, lines = ColumnCopies(library, cells, cutoff, dtype), 2 * cutoff + 1, cutoff + 1, 4
    cut, place = (cells - sum(cut[1:]), *cut[1:]), kept(cells, cutoff)
    for rows, gap in ((slice(0, 1), 0), (slice(0, 1), 3), (slice(1, 4), 0), (slice(1, 4), 3)):
        shape = (cells, rows.stop - rows.start, width)
        memory = np.zeros((cells, shape[1] * width + gap), dtype)
        column = memory[:, : shape[1] * width].reshape(shape)
        described, given = copies.described_column(column), noise(8, dtype, 3, modes, lines, width)
        for factors in (None, noise(7, dtype, modes)):
            copies.fill(copies.described(given), 2, rows, None if factors is None else copies.described(factors),
                        described)
            expected = np.zeros(shape, dtype)
            expected[place] = given[2, :, rows] * (1 if factors is None else factors[:, None, None])
            close(column, expected, TOLERANCE[dtype])
        column[:] = noise(9, dtype, *shape)
        stored = np.zeros_like(given)
        copies.store(described, 0.3, copies.described(stored), 1, rows)
        close(stored[1, :, rows], 0.3 * column[place], TOLERANCE[dtype])
        blocks = [np.zeros((3, planes, lines, width), dtype) for planes in cut]
        copies.send(described, copies.described_blocks(blocks), 1, rows)
        sent = np.concatenate(blocks, axis=1)
        assert np.array_equal(sent[1, :, rows], column)
        assert np.count_nonzero(sent) == np.count_nonzero(column)
        column[:] = 0
        copies.receive(copies.described_blocks(blocks), 1, rows, described)
        assert np.array_equal(column, sent[1, :, rows]) and not memory[:, shape[1] * width:].any()


def test_arrays_of_another_kind_are_refused(library):
    planes, columns = (kind(library, 12, 3, np.complex128) for kind in (PlaneCopies, ColumnCopies))
    blocks = planes.described_blocks([noise(1, np.complex128, 3, 7, 7, 4)])

    def array(*shape, dtype=np.complex128):
        return planes.described(noise(1, dtype, *shape))

    def column(*shape, dtype=np.complex128):
        return columns.described_column(noise(1, dtype, *shape))

    for call in (
            lambda: planes.described_blocks([noise(1, np.complex64, 3, 7, 7, 4)]),
            lambda: planes.described(np.zeros((2, 3, 4))[..., ::2]),
            lambda: planes.unpack(array(1, 11, 9), blocks, 0, slice(0, 2)),
            lambda: planes.unpack(array(1, 12, 9, dtype=np.complex64), blocks, 0, slice(0, 2)),
            lambda: planes.pack(planes.described_blocks([noise(1, np.complex128, 3, 7, 6, 4)]), slice(0, 2)),
            lambda: next(planes.filled(noise(1, np.complex128, 1, 1, 7, 6), None, array(1, 12, 9))),
            lambda: planes.join(array(1, 2, 12, 12), 0, slice(0, 2), array(1, 12, 12)),
            lambda: columns.described_column(np.zeros((2, 4, 4), np.complex128)[:, :, ::2]),
            lambda: columns.fill(array(1, 7, 4, 4), 0, slice(0, 3), array(6), column(12, 3, 4)),
            lambda: columns.fill(array(1, 7, 4, 4), 0, slice(0, 3), None, column(12, 2, 4)),
            lambda: columns.fill(array(1, 7, 4, 4), 0, slice(0, 3), None, column(12, 3, 4, dtype=np.complex64))):
        with pytest.raises(ValueError, match="needed"):
            call()
