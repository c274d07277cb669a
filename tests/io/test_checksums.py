"""A reader reports damaged bytes that it reads, with dataset and frame. It does not check other bytes."""

import h5py
import numpy as np
import pytest

from eddies.io.checksums import ATTRIBUTE, BLOCK_BYTES, PIECE, has_checksums
from eddies.io.errors import ProductError
from eddies.io.hdf5 import (append_frame, create_product, growing_dataset, open_product, read_frame, read_table,
                            write_table)
from tests.changed_product import changed

FRAMES, SHAPE = 5, (4, 300)  # of nearly two and a half blocks


def values(frame):
    return np.random.default_rng(frame).random(SHAPE)


@pytest.fixture
def path(comm, tmp_path):
    """A product with a table and with frames that all ranks write."""
    with create_product(comm, tmp_path / "rollout.h5", "rollout", {}) as file:
        write_table(file, "table", {"a": np.arange(1000.0), "b": np.ones(3)})
        series = growing_dataset(file, "series", SHAPE, np.float64)
        start, stop = 4 * comm.rank // comm.size, 4 * (comm.rank + 1) // comm.size
        for frame in range(FRAMES):
            append_frame(series, values(frame)[start:stop], (start, 0))
    return tmp_path / "rollout.h5"


def place_of(path, frame):
    """Where the bytes of a frame begin in the file."""
    with h5py.File(path) as file:
        return file["series"].id.get_chunk_info_by_coord((frame, 0, 0)).byte_offset


def harm(comm, path, at, count=1):
    """Invert bytes of a file that no rank reads."""
    comm.Barrier()
    if comm.rank == 0:
        content = bytearray(path.read_bytes())
        content[at:at + count] = bytes(255 - byte for byte in content[at:at + count])
        path.write_bytes(content)
    comm.Barrier()


@pytest.mark.mpi(1, 2, 3)
def test_other_programs_read_it_as_hdf5(comm, path):
    assert has_checksums(path)
    with h5py.File(path) as file:
        assert "CRC-32 of every 4096 bytes" in file.attrs[ATTRIBUTE]
        assert all(np.array_equal(file["series"][frame], values(frame)) for frame in range(FRAMES))


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("count", [1, 3000])
def test_a_reader_of_a_frame_is_told_of_its_bytes_alone(comm, path, count):
    whole = slice(None), slice(None)
    harm(comm, path, place_of(path, 2) + BLOCK_BYTES, count)
    with open_product(comm, path, "rollout") as file:
        assert np.array_equal(read_table(file, "table")["a"], np.arange(1000.0))
        for frame in (0, 4):
            assert np.array_equal(read_frame(file["series"], frame, whole), values(frame))
        with pytest.raises(ProductError) as told:
            read_frame(file["series"], 2, whole)
        assert np.array_equal(read_frame(file["series"], 4, whole), values(4))
    words = str(told.value)
    assert words.startswith(f"{path}: series, frame 2 (bytes ") and "\n" not in words
    assert words.endswith("is not what was written, the file is damaged; remove it and run `eddies simulate` again")


@pytest.mark.mpi(1)
def test_frames_that_changed_places_are_told(comm, path):
    content, places = bytearray(path.read_bytes()), [place_of(path, frame) for frame in (1, 3)]
    parts = [content[at:at + values(0).nbytes] for at in places]
    for at, part in zip(places, reversed(parts)):
        content[at:at + len(part)] = part
    path.write_bytes(content)
    with open_product(comm, path, "rollout") as file, pytest.raises(ProductError, match="series, frame [01] "):
        read_frame(file["series"], 1, (slice(None),))


@pytest.mark.mpi(1, 2)
def test_structure_and_attributes_count(comm, path):
    for at in 40, path.read_bytes().index(b"CRC-32 of every"):
        harm(comm, path, at)
        with pytest.raises(ProductError, match="rollout.h5: .*is not what was written"):
            with open_product(comm, path, "rollout") as file:
                dict(file.attrs)
        harm(comm, path, at)
    with open_product(comm, path, "rollout") as file:
        assert len(file["series"]) == FRAMES


@pytest.mark.mpi(1)
@pytest.mark.parametrize("cut", [1, 40, 5000])
def test_a_file_without_its_last_bytes_is_refused(comm, path, cut):
    path.write_bytes(path.read_bytes()[:-cut])
    with pytest.raises(ProductError, match=r"rollout.h5: damaged or not an HDF5 file \(.*delete it and make it again"):
        with open_product(comm, path, "rollout"):
            pass


@pytest.mark.mpi(1)
def test_what_another_program_has_changed_is_refused(comm, path):
    with h5py.File(path, "r+") as file:
        file["table/b"][1] = 2.0
    with pytest.raises(ProductError, match="checksums are missing: it was cut off, or another program has changed it"):
        with open_product(comm, path, "rollout"):
            pass


@pytest.mark.mpi(1, 2)
def test_a_product_of_before_there_were_checksums_is_read(comm, path):
    if comm.rank == 0:
        with h5py.File(path, "r+") as file:
            del file.attrs[ATTRIBUTE]
    comm.Barrier()
    assert not has_checksums(path)
    with open_product(comm, path, "rollout") as file:
        assert np.array_equal(file["series"][3], values(3))


@pytest.mark.mpi(1)
def test_what_is_changed_with_new_checksums_is_read(comm, path):
    with changed(path) as file:
        file["table/b"][1] = 2.0
    with open_product(comm, path, "rollout") as file:
        assert np.array_equal(read_table(file, "table")["b"], [1, 2, 1])


@pytest.mark.mpi(1)
def test_an_array_that_is_read_in_pieces(comm, tmp_path):
    many = np.random.default_rng(1).random(3 * PIECE * BLOCK_BYTES // 16)
    with create_product(comm, tmp_path / "a.h5", "kernel", {}) as file:
        write_table(file, "table", {"many": many})
    with open_product(comm, tmp_path / "a.h5", "kernel") as file:
        assert np.array_equal(read_table(file, "table")["many"], many)
        place = file["table/many"].id.get_offset()
    harm(comm, tmp_path / "a.h5", place + many.nbytes - 1)
    with open_product(comm, tmp_path / "a.h5", "kernel") as file:
        with pytest.raises(ProductError, match="table/many .*not what was written"):
            read_table(file, "table")
