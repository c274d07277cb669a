"""Products: complete or absent, refused when they are not what they should be."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from eddies.io.errors import WriteError
from eddies.io.fields import FieldWriter
from eddies.io.hdf5 import (CHUNK_BYTES, ProductError, create_product, growing_dataset, in_files, open_product,
                            read_attributes, read_table, stored_numbers, write_table)
from eddies.io.provenance import product_fingerprint, product_provenance, read_provenance
from eddies.io.trajectories import TrajectoryWriter
from eddies.parallel.stop import Stopped
from tests.commands import first_rank
from tests.changed_product import changed


def write(comm, path, kind="kernel"):
    with create_product(comm, path, kind, {"scene": "[flow]", "fingerprint": "abc"}) as file:
        write_table(file, "statistics", {"time": np.arange(3.0), "nothing": np.zeros((0, 2))})
        file.create_group("reference").attrs.update({"length": 0.5, "name": "x"})
    return path


@pytest.mark.mpi(1, 3)
def test_table_attributes_and_provenance(comm, tmp_path):
    path = write(comm, tmp_path / "a.h5")
    with open_product(comm, path, "kernel") as file:
        table = read_table(file, "statistics")
        assert np.array_equal(table["time"], [0, 1, 2]) and table["nothing"].shape == (0, 2)
        assert read_attributes(file, "reference") == {"length": 0.5, "name": "x"}
        origin = read_provenance(file)
        with pytest.raises(ProductError, match="a.h5: holds no spectra; its group / holds reference, statistics"):
            read_table(file, "spectra")
    assert origin["ranks"] == comm.size and origin["scene"] == "[flow]"
    assert product_fingerprint(path) == "abc"
    assert not (tmp_path / "a.h5.partial").exists()


@pytest.mark.mpi(2)
def test_an_exception_leaves_the_old_product_or_none(comm, tmp_path):
    write(comm, tmp_path / "a.h5")
    for name in ("a.h5", "b.h5"):
        with pytest.raises(ZeroDivisionError):
            with create_product(comm, tmp_path / name, "kernel", {"fingerprint": "new"}) as file:
                file.flush()
                1 / 0
    assert product_fingerprint(tmp_path / "a.h5") == "abc" and not (tmp_path / "b.h5").exists()


@pytest.mark.mpi(2)
def test_unfinished_product_is_refused(comm, tmp_path):
    unfinished = tmp_path / "unfinished.h5"
    if comm.rank == 0:
        with h5py.File(unfinished, "w") as file:
            file.attrs.update({"kind": "model", "complete": False, "provenance": "{}"})
    comm.Barrier()
    with pytest.raises(ProductError, match="unfinished.h5: unfinished, .* run `eddies train SCENE`"):
        with open_product(comm, unfinished, "model"):
            pass
    assert product_fingerprint(unfinished) is None


@pytest.mark.mpi(1, 3)
def test_missing_and_wrong_kind(comm, tmp_path):
    """All ranks raise, also if only the last one cannot open the file."""
    path = write(comm, tmp_path / "a.h5")
    for seen in (tmp_path / "b.h5", path if comm.rank < comm.size - 1 else tmp_path / "b.h5"):
        with pytest.raises(ProductError, match="b.h5: no such file; run `eddies train-kernel SCENE` first"):
            with open_product(comm, seen, "kernel"):
                pass
    with pytest.raises(ProductError, match="of kind kernel, expected ground_truth: run `eddies dns SCENE`"):
        with open_product(comm, path, "ground_truth"):
            pass
    assert product_fingerprint(tmp_path / "b.h5") is None


@pytest.mark.mpi(1)
def test_another_format_is_refused(comm, tmp_path):
    """A later version stores another number, and eddies 0.1.0 stored none."""
    for kind, number, remedy in (("ground_truth", None, "run `eddies dns` again"),
                                 ("measures", None, "run `eddies measure` on its directory again"),
                                 ("frames", 4, "make it again")):
        path = write(comm, tmp_path / "a.h5", kind)
        assert product_fingerprint(path) == "abc"
        with changed(path) as file:
            del file.attrs["format"]
            if number is not None:
                file.attrs["format"] = number
            file.attrs["provenance"] = json.dumps(json.loads(file.attrs["provenance"]) | {"eddies": "7.8.9"})
        for asked in (kind, None):
            with pytest.raises(ProductError, match=f"a.h5: written by eddies 7.8.9, .*{remedy}"):
                with open_product(comm, path, asked):
                    pass
        assert product_fingerprint(path) is None and product_provenance(path) == {}


@pytest.mark.mpi(1)
def test_chunks_hold_at_most_a_mebibyte(comm, tmp_path):
    with create_product(comm, tmp_path / "a.h5", "kernel", {}) as file:
        for shape in ((), (5,), (262144, 3), (3, 96, 96, 96)):
            dataset = growing_dataset(file, f"values-{len(shape)}", shape, np.float64)
            assert np.prod(dataset.chunks) * dataset.dtype.itemsize <= CHUNK_BYTES


@pytest.mark.mpi(2, timeout=30)
def test_all_ranks_raise_if_rank_0_cannot_write(comm, tmp_path, monkeypatch):
    first_rank(comm, (tmp_path / "a.h5/something").mkdir, parents=True)
    with pytest.raises(WriteError, match="a.h5: Is a directory"):
        in_files(comm, tmp_path / "a.h5", lambda: (tmp_path / "a.h5").write_text("{}"))

    def fail():
        raise OSError("cannot synchronously read data")  # HDF5 gives no name of the file

    with pytest.raises(WriteError, match="a.json: cannot synchronously read data"):
        in_files(comm, tmp_path / "a.json", fail)
    with pytest.raises(WriteError, match="a.h5.*directory; check"):  # it cannot get its name
        write(comm, tmp_path / "a.h5")
    with pytest.raises(WriteError, match="no/a.h5.partial: No such file or directory"):
        write(comm, tmp_path / "no/a.h5")

    def refuse(path, missing_ok=False):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(WriteError, match="b.h5.partial: Permission denied"):
        with create_product(comm, tmp_path / "b.h5", "kernel", {}):
            raise Stopped("SIGTERM")


@pytest.mark.mpi(1)
def test_all_numbers_are_listed_and_of_series_the_last_frame(comm, tmp_path):
    with create_product(comm, tmp_path / "a.h5", "rollout", {}) as file:
        write_table(file, "errors", {"delay": np.arange(3.0), "count": np.arange(3), "single": 0.5})
        file.create_group("rollout").attrs.update({"status": "complete", "turnovers": 1.5, "ranks": 2})
        trajectory = TrajectoryWriter(file, "model", 4, 1.0, {"velocity": (3,)}, np.float64)
        fields = FieldWriter(file, "model", 2, {"velocity": 3})
        TrajectoryWriter(file, "none", 4, 1.0, {"velocity": (3,)}, np.float64)
        for frame in range(3):
            trajectory.append(frame, 0.1 * frame, 0, {"velocity": np.full((4, 3), frame)})
            fields.append(0.1 * frame, 0, {"velocity": np.full((3, 2, 2, 2), frame)})
    with open_product(comm, tmp_path / "a.h5", "rollout") as file:
        found = {place: (frame, np.max(values)) for place, frame, values in stored_numbers(file)}
    assert found == {
        "errors/delay": (None, 2), "errors/single": (None, 0.5), "rollout, attribute turnovers": (None, 1.5),
        "particles/model/box/edges/value": (2, 1), "particles/model/box, attribute edge": (None, 1),
        "particles/none/box, attribute edge": (None, 1), "fields/model/velocity": (2, 2),
        "particles/model/velocity/value": (2, 2), "fields/model/time": (2, 0.2),
        **{place: (2, 0.2) for place in found if place.startswith("particles/model") and place.endswith("time")}}
