"""Every byte of a file counts, on any number of ranks."""

import random
import shutil

import numpy as np
import pytest

from eddies.io.hdf5 import create_product, write_table
from eddies.io.verification import add_checksums, find_damage, known_sums


@pytest.fixture
def path(comm, tmp_path):
    columns = {f"column {number}": np.random.default_rng(number).random(2000) for number in range(9)}
    with create_product(comm, tmp_path / "kernel.h5", "kernel", {}) as file:
        write_table(file, "table", columns)
    return tmp_path / "kernel.h5"


@pytest.mark.mpi(1, 2, 3)
def test_every_changed_byte_is_found(comm, path):
    assert find_damage(comm, path) is None
    size, chooser = path.stat().st_size, random.Random(comm.size)
    comm.Barrier()
    places = [0, size - 1, size - 20, size - 30, *(chooser.randrange(size) for _ in range(100 // comm.size))]
    for at in places:
        with open(path, "r+b", buffering=0) as file:
            if comm.rank == 0:
                file.seek(at)
                byte = file.read(1)[0]
                file.seek(at)
                file.write(bytes([byte ^ 1 << chooser.randrange(8)]))
            comm.Barrier()
            told = find_damage(comm, path)
            assert told is not None and told.startswith(f"{path}: "), at
            assert comm.bcast(told) == told
            comm.Barrier()
            if comm.rank == 0:
                file.seek(at)
                file.write(bytes([byte]))
            comm.Barrier()
    assert find_damage(comm, path) is None


@pytest.mark.mpi(1, 2)
def test_sums_do_not_depend_on_ranks(comm, path, tmp_path):
    sizes = [0, 1, 4096, 4097, 10**6]
    for size in sizes:
        if comm.rank == 0:
            (tmp_path / "plain").write_bytes(random.Random(size).randbytes(size))
            shutil.copy(tmp_path / "plain", tmp_path / "alone")
            add_checksums(comm.Create_group(comm.group.Incl([0])), tmp_path / "alone")
        comm.Barrier()
        add_checksums(comm, tmp_path / "plain")
        assert (tmp_path / "plain").read_bytes() == (tmp_path / "alone").read_bytes()
        comm.Barrier()


@pytest.mark.mpi(1, 2)
def test_another_file_than_was_known_is_told(comm, path, tmp_path):
    known = known_sums(path)
    assert find_damage(comm, path, known) is None
    assert find_damage(comm, path, known + 1) == f"{path}: is another file than was written"
    assert find_damage(comm, tmp_path / "nowhere.h5") == f"{tmp_path / 'nowhere.h5'}: missing"
