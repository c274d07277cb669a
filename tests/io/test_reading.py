"""Files are read where HDF5's lock fails, and what the system refuses is no damage."""

import errno
import fcntl
import os
import subprocess
import sys

import pytest

from eddies.io import hdf5
from eddies.io.hdf5 import ProductError, create_product, open_product
from eddies.io.reading import open_to_read

NO_LOCKS = """
#include <errno.h>
extern "C" int flock(int, int) { errno = ENOLCK; return -1; }
"""


@pytest.fixture
def product(comm, tmp_path):
    with create_product(comm, tmp_path / "kernel.h5", "kernel", {}) as file:
        file["a"] = 1.5
    return tmp_path / "kernel.h5"


@pytest.mark.mpi(1, 2)
def test_a_file_that_another_program_holds_is_read(comm, product):
    with open(product, "r+b") as held:
        if comm.rank == 0:
            fcntl.flock(held, fcntl.LOCK_EX)
        comm.Barrier()
        with open_product(comm, product, "kernel") as file:
            assert file["a"][()] == 1.5
        comm.Barrier()


@pytest.mark.mpi(1)
def test_a_file_system_without_locks(comm, product, tmp_path):
    """By a library that fails the call, loaded before all others."""
    (tmp_path / "no_locks.cpp").write_text(NO_LOCKS)
    subprocess.run(["g++", "-shared", "-fPIC", "-o", tmp_path / "no_locks.so", tmp_path / "no_locks.cpp"], check=True)
    code = ("import sys, h5py\nfrom eddies.io.reading import open_to_read\n"
            "print(open_to_read(sys.argv[1])['a'][()])\nh5py.File(sys.argv[1], 'r')\n")
    ended = subprocess.run([sys.executable, "-c", code, product], capture_output=True, text=True,
                           env={**os.environ, "LD_PRELOAD": str(tmp_path / "no_locks.so")})
    # The library is at work: with its own lock HDF5 does not open the file.
    assert ended.stdout == "1.5\n" and ended.returncode == 1 and "No locks available" in ended.stderr


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EAGAIN, errno.EIO, errno.ESTALE])
def test_what_the_system_refuses_is_told_as_it_is(comm, product, monkeypatch, number):
    def refuse(path):
        raise OSError(number, f"Unable to open file (errno = {number})")

    monkeypatch.setattr(hdf5, "open_to_read", refuse)
    with pytest.raises(ProductError) as error, open_product(comm, product, "kernel"):
        pass
    assert f"cannot be read: {os.strerror(number)}; check its permissions" in str(error.value)
    assert "damaged" not in str(error.value) and "delete" not in str(error.value)


@pytest.mark.mpi(1, timeout=30)
def test_a_pipe_in_place_of_a_file_is_not_waited_for(comm, tmp_path):
    os.mkfifo(tmp_path / "kernel.h5")
    with pytest.raises(OSError, match="not a regular file"):
        open_to_read(tmp_path / "kernel.h5")


@pytest.mark.mpi(1)
@pytest.mark.parametrize("damage", [lambda content: content[:len(content) // 2], lambda content: b"x" + content[1:-1],
                                    lambda content: b""])
def test_what_hdf5_finds_wrong_is_damage(comm, product, damage):
    product.write_bytes(damage(product.read_bytes()))
    with pytest.raises(ProductError, match="damaged or not an HDF5 file"), open_product(comm, product, "kernel"):
        pass
