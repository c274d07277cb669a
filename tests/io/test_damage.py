"""HDF5 finds changed bytes in all that this package writes; errors name dataset and frame."""

import errno
import fcntl
import random

import h5py
import numpy as np
import pytest

from eddies.io import damage
from eddies.io.damage import checked_attributes, find_damage
from eddies.io.errors import ContentError, ProductError
from eddies.io.fields import FieldWriter
from eddies.io.hdf5 import (append_frame, create_product, growing_dataset, open_product, read_frame, read_table,
                            write_table)
from eddies.io.trajectories import TrajectoryWriter
from eddies.io.weights import load_weights, save_weights

FRAMES, SHAPE = 5, (4, 300)


def values(frame):
    return np.random.default_rng(frame).random(SHAPE)


@pytest.fixture
def path(comm, tmp_path):
    """A product with a table, and with frames that all ranks write."""
    with create_product(comm, tmp_path / "rollout.h5", "rollout", {"scene": "a text"}) as file:
        write_table(file, "table", {"a": np.arange(1000.0), "b": np.ones(3), "number": 2.5, "none": np.zeros(0)})
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


@pytest.mark.mpi(2)
def test_a_reader_of_a_frame_is_told_of_its_bytes_alone(comm, path):
    whole = slice(None), slice(None)
    harm(comm, path, place_of(path, 2) + 100)
    with open_product(comm, path, "rollout") as file:
        assert np.array_equal(read_table(file, "table")["a"], np.arange(1000.0))
        for frame in (0, 4):
            assert np.array_equal(read_frame(file["series"], frame, whole), values(frame))
    with pytest.raises(ContentError) as error, open_product(comm, path, "rollout") as file:
        read_frame(file["series"], 2, whole)
    message = str(error.value)
    assert message.startswith(f"{path}: the file is damaged: series, frame 2; ") and "\n" not in message
    assert "run `eddies simulate` again" in message
    assert find_damage(comm, path) == f"{path}: the file is damaged: series, frame 2"


@pytest.mark.mpi(1)
def test_a_file_that_is_cut_off_or_overwritten_is_damaged(comm, path):
    content = path.read_bytes()
    for changed_content in (content[:-1], content[:-5000], content[:len(content) // 2], b"x" + content[1:-1], b""):
        path.write_bytes(changed_content)
        with pytest.raises(ProductError, match="rollout.h5: damaged"), open_product(comm, path, "rollout"):
            pass


def everything(path):
    """All values and attributes of a file, as bytes. Texts of H5MD, which have no checksum, are left out."""
    found = {}
    with h5py.File(path, locking=False) as file:
        names = []
        file.visit(names.append)
        for name in (".", *names):
            found |= {(name, key): np.asarray(value).tobytes() for key, value in checked_attributes(file[name]).items()}
            if isinstance(file[name], h5py.Dataset):
                found[name] = file[name].shape, file[name][()].tobytes()
    return found


@pytest.mark.mpi(1)
def test_no_changed_bit_gives_a_wrong_value(comm, tmp_path):
    """The file is small and has all parts of a product. Some bits are not used, such as those of free space."""
    path = tmp_path / "rollout.h5"
    with create_product(comm, path, "rollout", {"scene": "text " * 200}) as file:
        write_table(file, "table", {"a": np.arange(40.0), "number": 2.5})
        particles = TrajectoryWriter(file, "model", 20, 1.0, {"position": (3,), "velocity": (3,)}, np.float32)
        field = FieldWriter(file, "filtered", 4, {"velocity": 3})
        for frame in range(2):
            particles.append(frame, float(frame), 0, dict.fromkeys(("position", "velocity"), np.full((20, 3), 0.5)))
            field.append(float(frame), 0, {"velocity": np.full((3, 4, 4, 4), 1.5)})
    content, whole, chooser, found = path.read_bytes(), everything(path), random.Random(1), 0
    for _ in range(150):
        bit, harmed = chooser.randrange(8 * len(content)), bytearray(content)
        harmed[bit // 8] ^= 1 << bit % 8
        path.write_bytes(harmed)
        try:
            assert everything(path) == whole, bit
        except (OSError, RuntimeError, KeyError, ValueError):  # of HDF5
            assert find_damage(comm, path), bit
            found += 1
    assert found > 110


@pytest.mark.mpi(2)
def test_large_weights_are_checked(comm, tmp_path):
    many, path = np.random.default_rng(1).random(300_000), tmp_path / "model.h5"
    save_weights(comm, path, "model", {}, {"many": many}, {})
    assert np.array_equal(load_weights(comm, path, "model").weights["many"], many)
    with h5py.File(path) as file:
        place = file["weights/many"].id.get_chunk_info(1).byte_offset
    harm(comm, path, place + 1000)
    with pytest.raises(ProductError, match="model.h5: the file is damaged: weights/many"):
        load_weights(comm, path, "model")


@pytest.mark.mpi(1, 3)
def test_a_missing_file_is_found(comm, path, tmp_path):
    assert find_damage(comm, path) is None
    assert find_damage(comm, tmp_path / "nowhere.h5") == f"{tmp_path / 'nowhere.h5'}: missing"


@pytest.mark.mpi(1)
def test_a_file_that_another_program_locks_is_read(comm, path):
    with open(path, "r+b") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with open_product(comm, path, "rollout") as file:
            assert len(file["series"]) == FRAMES


@pytest.mark.mpi(1)
@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EIO])
def test_a_refusal_of_the_system_is_no_damage(comm, path, monkeypatch, number):
    def refuse(_):
        raise OSError(number, "Unable to open file")

    monkeypatch.setattr(damage, "_opened", refuse)
    with pytest.raises(ProductError, match="rollout.h5: cannot be read: ") as error:
        with open_product(comm, path, "rollout"):
            pass
    assert not isinstance(error.value, ContentError) and "damaged" not in str(error.value)
