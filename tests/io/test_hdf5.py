"""Products: complete or absent, refused when they are not what they should be."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from eddies.io.hdf5 import (CHUNK_BYTES, ProductError, append_frame, create_product, growing_dataset, in_files,
                            open_product, read_table, write_attributes, write_table)
from eddies.io.provenance import product_fingerprint, product_provenance, read_provenance
from eddies.parallel.stop import Stopped
from eddies.pipeline import MAKER_OF
from tests.changed_product import changed


def write(comm, path, kind="kernel"):
    with create_product(comm, path, kind, {"scene": "[flow]", "fingerprint": "abc"}) as file:
        write_table(file, "statistics", {"time": np.arange(3.0), "nothing": np.zeros((0, 2))})
        write_attributes(file.create_group("reference"), {"length": 0.5, "name": "x"})
    return path


@pytest.mark.mpi(1, 2, 3)
def test_table_attributes_and_provenance(comm, tmp_path):
    path = write(comm, tmp_path / "a.h5")
    with open_product(comm, path, "kernel") as file:
        table = read_table(file, "statistics")
        assert np.array_equal(table["time"], [0, 1, 2]) and table["nothing"].shape == (0, 2)
        assert dict(file["reference"].attrs) == {"length": 0.5, "name": "x"}
        origin = read_provenance(file)
    assert origin["ranks"] == comm.size
    assert {"eddies", "libraries", "date", "scene", "commit"} <= origin.keys()
    assert product_fingerprint(path) == "abc"
    assert not (tmp_path / "a.h5.partial").exists()


@pytest.mark.mpi(1, 2, 3)
def test_exception_leaves_the_old_product(comm, tmp_path):
    path = write(comm, tmp_path / "a.h5")
    with pytest.raises(ZeroDivisionError):
        with create_product(comm, path, "kernel", {"fingerprint": "new"}):
            1 / 0
    assert product_fingerprint(path) == "abc"


@pytest.mark.mpi(1, 2)
def test_unfinished_product_is_refused(comm, tmp_path):
    with pytest.raises(ZeroDivisionError):
        with create_product(comm, tmp_path / "a.h5", "model", {"fingerprint": "abc"}) as file:
            file.flush()
            1 / 0
    comm.Barrier()
    assert not (tmp_path / "a.h5").exists()
    unfinished = tmp_path / "unfinished.h5"
    if comm.rank == 0:
        with h5py.File(unfinished, "w") as file:
            write_attributes(file, {"kind": "model", "complete": False, "provenance": "{}"})
    comm.Barrier()
    with pytest.raises(ProductError, match="unfinished.h5: unfinished, .* run `eddies train SCENE`"):
        with open_product(comm, unfinished, "model"):
            pass
    assert product_fingerprint(unfinished) is None


@pytest.mark.mpi(1, 2)
def test_missing_and_wrong_kind(comm, tmp_path):
    with pytest.raises(ProductError, match="b.h5: no such file; run `eddies dns SCENE` first"):
        with open_product(comm, tmp_path / "b.h5", "ground_truth"):
            pass
    path = write(comm, tmp_path / "a.h5")
    with pytest.raises(ProductError, match="of kind kernel, expected ground_truth: run `eddies dns SCENE`"):
        with open_product(comm, path, "ground_truth"):
            pass
    assert product_fingerprint(tmp_path / "b.h5") is None


def change_format(comm, path, number):
    """As another version writes it: with another number, or None, as eddies 0.1.0 wrote none."""
    if comm.rank == 0:
        with changed(path) as file:
            del file.attrs["format"]
            if number is not None:
                file.attrs["format"] = number
            provenance = json.loads(file.attrs["provenance"])
            file.attrs["provenance"] = json.dumps({**provenance, "eddies": "7.8.9"})
    comm.Barrier()


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("number", [None, 1, 4])
@pytest.mark.parametrize("kind, remedy", [
    *((kind, f"remove it and run `eddies {stage.name}` again") for kind, stage in MAKER_OF.items()),
    ("frames", "make it again")])
def test_another_format_is_refused_and_is_no_result(comm, tmp_path, kind, remedy, number):
    path = write(comm, tmp_path / "a.h5", kind)
    assert product_fingerprint(path) == "abc"
    comm.Barrier()
    change_format(comm, path, number)
    for asked in (kind, None):
        with pytest.raises(ProductError) as refused:
            with open_product(comm, path, asked):
                pass
        assert str(refused.value) == (f"{path}: written by eddies 7.8.9, whose {kind.replace('_', ' ')} this version "
                                      f"does not read; {remedy}")
    assert product_fingerprint(path) is None and product_provenance(path) == {}


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("kept", [0, 7, 0.5, 0.999])
def test_truncated_product_is_named(comm, tmp_path, kept):
    path = write(comm, tmp_path / "a.h5")
    if comm.rank == 0:
        content = path.read_bytes()
        path.write_bytes(content[:kept if isinstance(kept, int) else int(kept * len(content))])
    comm.Barrier()
    with pytest.raises(ProductError, match="a.h5: damaged or not an HDF5 file"):
        with open_product(comm, path, "kernel"):
            pass


@pytest.mark.mpi(2, 3)
def test_all_ranks_raise_when_one_cannot_open(comm, tmp_path):
    path = write(comm, tmp_path / "a.h5")
    seen = path if comm.rank else tmp_path / "elsewhere.h5"
    with pytest.raises(ProductError, match="no such file" if comm.rank == 0 else "1 of . ranks cannot open"):
        with open_product(comm, seen, "kernel"):
            pass


@pytest.mark.mpi(1, 2)
def test_directory_that_is_not_there(comm, tmp_path):
    with pytest.raises(ProductError, match="cannot be written"):
        with create_product(comm, tmp_path / "no" / "a.h5", "kernel", {}):
            pass


@pytest.mark.mpi(1)
def test_unknown_table_lists_the_others(comm, tmp_path):
    path = write(comm, tmp_path / "a.h5")
    with open_product(comm, path, "kernel") as file:
        with pytest.raises(ProductError, match="a.h5: holds no spectra; / holds: reference, statistics"):
            read_table(file, "spectra")


@pytest.mark.mpi(1)
@pytest.mark.parametrize("shape, dtype", [((), float), ((5,), float), ((262144, 3), np.float32),
                                          ((3, 96, 96, 96), np.float32)])
def test_chunks_hold_at_most_a_mebibyte(comm, tmp_path, shape, dtype):
    with create_product(comm, tmp_path / "a.h5", "kernel", {}) as file:
        dataset = growing_dataset(file, "values", shape, dtype)
        assert np.prod(dataset.chunks) * dataset.dtype.itemsize <= CHUNK_BYTES


@pytest.mark.mpi(2, 3)
def test_blocks_of_any_size_make_a_frame(comm, tmp_path):
    """Rank r writes r rows, so rank 0 writes none; then the last rank writes everything."""
    total = comm.size * (comm.size - 1) // 2
    starts = [rank * (rank - 1) // 2 for rank in range(comm.size + 1)]
    with create_product(comm, tmp_path / "a.h5", "kernel", {}) as file:
        dataset = growing_dataset(file, "values", (total, 2), np.float64)
        start, stop = starts[comm.rank], starts[comm.rank + 1]
        append_frame(dataset, np.arange(2 * start, 2 * stop).reshape(-1, 2), (start, 0))
        mine = total if comm.rank == comm.size - 1 else 0
        append_frame(dataset, np.full((mine, 2), 7.0), (0, 0))
    with open_product(comm, tmp_path / "a.h5", "kernel") as file:
        assert np.array_equal(file["values"][0], np.arange(2 * total).reshape(-1, 2))
        assert np.array_equal(file["values"][1], np.full((total, 2), 7.0))


def in_the_way(comm, path):
    """A directory with a file in it where a file should be."""
    if comm.rank == 0:
        (path / "something").mkdir(parents=True)
    comm.Barrier()


@pytest.mark.mpi(1, 2, timeout=30)
def test_a_file_that_rank_0_cannot_write_is_told_by_all(comm, tmp_path):
    in_the_way(comm, tmp_path / "a.json")
    with pytest.raises(ProductError, match="a.json: Is a directory; check the file, its directory and the space on"):
        in_files(comm, tmp_path / "a.json", lambda: (tmp_path / "a.json").write_text("{}"))

    def fail():
        raise OSError("cannot synchronously read data")  # as HDF5 tells it, without the name of the file

    with pytest.raises(ProductError, match="a.json: cannot synchronously read data; check the file"):
        in_files(comm, tmp_path / "a.json", fail)


@pytest.mark.mpi(1, 2, timeout=30)
def test_a_product_that_cannot_get_its_name_is_told_by_all(comm, tmp_path):
    in_the_way(comm, tmp_path / "a.h5")
    with pytest.raises(ProductError, match="a.h5.partial: .*directory; check the file"):
        write(comm, tmp_path / "a.h5")


@pytest.mark.mpi(1, 2, timeout=30)
def test_an_unfinished_product_that_cannot_be_removed_is_told_by_all(comm, tmp_path, monkeypatch):
    def refuse(path, missing_ok=False):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(ProductError, match="a.h5.partial: Permission denied; check the file"):
        with create_product(comm, tmp_path / "a.h5", "kernel", {}):
            raise Stopped("SIGTERM")
