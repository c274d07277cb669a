"""Damaged bytes are reported with dataset and frame; a reader checks only the bytes that it reads."""

import errno
import fcntl
import os
import random

import h5py
import numpy as np
import pytest

from eddies.io import checksums
from eddies.io.checksums import ATTRIBUTE, BLOCK_BYTES, PIECE, find_damage, table_checksum
from eddies.io.errors import ContentError, ProductError
from eddies.io.hdf5 import (append_frame, create_product, growing_dataset, open_product, read_frame, read_table,
                            write_table)
from eddies.io.weights import load_weights, save_weights
from tests.changed_product import changed

FRAMES, SHAPE = 5, (4, 300)  # a frame has nearly two and a half blocks


def values(frame):
    return np.random.default_rng(frame).random(SHAPE)


@pytest.fixture
def path(comm, tmp_path):
    """A product with a table, and with frames that all ranks write."""
    with create_product(comm, tmp_path / "rollout.h5", "rollout", {}) as file:
        write_table(file, "table", {"a": np.arange(1000.0), "b": np.ones(3)})
        series = growing_dataset(file, "series", SHAPE, np.float64)
        start, stop = 4 * comm.rank // comm.size, 4 * (comm.rank + 1) // comm.size
        for frame in range(FRAMES):
            append_frame(series, values(frame)[start:stop], (start, 0))
    return tmp_path / "rollout.h5"


def place_of(path, frame):
    """The offset of a frame in the file."""
    with h5py.File(path) as file:
        return file["series"].id.get_chunk_info_by_coord((frame, 0, 0)).byte_offset


def harm(comm, path, at):
    """Invert a byte of a file while no rank reads it."""
    comm.Barrier()
    if comm.rank == 0:
        content = bytearray(path.read_bytes())
        content[at] ^= 255
        path.write_bytes(content)
    comm.Barrier()


@pytest.mark.mpi(1, 2)
def test_a_reader_of_a_frame_is_told_of_its_bytes_alone(comm, path):
    whole = slice(None), slice(None)
    harm(comm, path, place_of(path, 2) + BLOCK_BYTES)
    with open_product(comm, path, "rollout") as file:
        assert np.array_equal(read_table(file, "table")["a"], np.arange(1000.0))
        for frame in (0, 4):
            assert np.array_equal(read_frame(file["series"], frame, whole), values(frame))
        with pytest.raises(ProductError) as error:
            read_frame(file["series"], 2, whole)
        assert np.array_equal(read_frame(file["series"], 4, whole), values(4))
    message = str(error.value)
    assert message.startswith(f"{path}: the file is damaged: wrong checksum of series, frame 2 (bytes ")
    assert "\n" not in message and "run `eddies simulate` again" in message


@pytest.mark.mpi(1)
def test_structure_and_attributes_are_covered(comm, path):
    for at in 40, path.read_bytes().index(b"CRC-32 of every"):
        harm(comm, path, at)
        with pytest.raises(ProductError, match="rollout.h5: .*damaged"):
            with open_product(comm, path, "rollout") as file:
                dict(file.attrs)
        harm(comm, path, at)
    with open_product(comm, path, "rollout") as file:
        assert len(file["series"]) == FRAMES


@pytest.mark.mpi(1)
def test_a_file_that_is_cut_off_or_overwritten_is_damaged(comm, path):
    content = path.read_bytes()
    for changed_content in (content[:-1], content[:-5000], content[:len(content) // 2], b"x" + content[1:-1], b""):
        path.write_bytes(changed_content)
        with pytest.raises(ProductError, match="rollout.h5: damaged"), open_product(comm, path, "rollout"):
            pass


@pytest.mark.mpi(1)
def test_changes_by_other_programs(comm, path):
    """They are refused, unless the checksums are renewed; a product of an old version has none."""
    with h5py.File(path, "r+") as file:
        file["table/b"][1] = 2.0
    with pytest.raises(ProductError, match="checksums are missing"), open_product(comm, path, "rollout"):
        pass
    with changed(path) as file:
        file["table/b"][0] = 3.0
    with open_product(comm, path, "rollout") as file:
        assert np.array_equal(read_table(file, "table")["b"], [3, 2, 1])
    with h5py.File(path, "r+") as file:
        del file.attrs[ATTRIBUTE]
    with open_product(comm, path, "rollout") as file:
        assert np.array_equal(file["series"][3], values(3))


@pytest.mark.mpi(1, 2)
def test_weights_that_are_read_in_pieces(comm, tmp_path):
    many, path = np.random.default_rng(1).random(3 * PIECE * BLOCK_BYTES // 16), tmp_path / "model.h5"
    save_weights(comm, path, "model", {}, {"many": many}, {})
    assert np.array_equal(load_weights(comm, path, "model").weights["many"], many)
    with h5py.File(path) as file:
        place = file["weights/many"].id.get_offset()
    harm(comm, path, place + many.nbytes - 2 * BLOCK_BYTES)
    with pytest.raises(ProductError, match="model.h5: the file is damaged: .* weights/many "):
        load_weights(comm, path, "model")


@pytest.mark.mpi(1, 3)
def test_every_changed_byte_is_found(comm, path):
    assert find_damage(comm, path) is None
    size, chooser = path.stat().st_size, random.Random(comm.size)
    comm.Barrier()
    for at in [0, size - 1, size - 20, size - 30, *(chooser.randrange(size) for _ in range(40 // comm.size))]:
        with open(path, "r+b", buffering=0) as file:
            if comm.rank == 0:
                file.seek(at)
                byte = file.read(1)[0]
                file.seek(at)
                file.write(bytes([byte ^ 1 << chooser.randrange(8)]))
            comm.Barrier()
            damage = find_damage(comm, path)
            assert damage is not None and damage.startswith(f"{path}: "), at
            assert comm.bcast(damage) == damage
            comm.Barrier()
            if comm.rank == 0:
                file.seek(at)
                file.write(bytes([byte]))
            comm.Barrier()
    assert find_damage(comm, path) is None


@pytest.mark.mpi(1)
def test_another_or_a_missing_file_is_found(comm, path, tmp_path):
    known = table_checksum(path)
    assert find_damage(comm, path, known) is None
    assert "is not the file that was written" in find_damage(comm, path, known + 1)
    assert "nowhere.h5: missing" in find_damage(comm, tmp_path / "nowhere.h5")


@pytest.mark.mpi(1)
def test_a_file_that_another_program_locks_is_read(comm, path):
    """With checksums, and an old one without."""
    for old in (False, True):
        if old:
            with h5py.File(path, "r+") as file:
                del file.attrs[ATTRIBUTE]
        with open(path, "r+b") as held:
            fcntl.flock(held, fcntl.LOCK_EX)
            with open_product(comm, path, "rollout") as file:
                assert len(file["series"]) == FRAMES


@pytest.mark.mpi(1)
@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EIO])
def test_a_refusal_of_the_system_is_no_damage(comm, path, monkeypatch, number):
    """When the file is opened, and later."""
    def refuse(*_):
        raise OSError(number, "Unable to open file")

    with open_product(comm, path, "rollout") as file:
        for module, name in ((os, "preadv"), (checksums, "_opened")):
            with monkeypatch.context() as patch, pytest.raises(ProductError) as error:
                patch.setattr(module, name, refuse)
                read_frame(file["series"], 2, (slice(None), slice(None)))
                with open_product(comm, path, "rollout"):
                    pass
            assert f"rollout.h5: cannot be read: {os.strerror(number)}" in str(error.value)
            assert not isinstance(error.value, ContentError) and "damaged" not in str(error.value)
