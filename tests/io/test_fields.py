"""Fields: slabs of any thickness make the whole."""

import numpy as np
import pytest

from eddies.io.fields import FieldSeries, FieldWriter
from eddies.io.hdf5 import ProductError, create_product, open_product
from tests.changed_product import changed

CELLS = 6
VARIABLES = {"velocity": 3, "density": 1}


def field(index, variable):
    shape = (VARIABLES[variable], CELLS, CELLS, CELLS)
    return np.random.default_rng([index, VARIABLES[variable]]).random(shape)


def write(comm, path, start=0, stop=CELLS):
    with create_product(comm, path, "ground_truth", {}) as file:
        writer = FieldWriter(file, "filtered", CELLS, VARIABLES)
        for index in range(2):
            writer.append(0.1 * index, start, {name: field(index, name)[:, start:stop] for name in VARIABLES})


@pytest.mark.mpi(1, 3)
def test_fields_survive(comm, tmp_path):
    """The first of three ranks has all planes but one, the second none."""
    starts = [0, *[CELLS - 1] * (comm.size - 1), CELLS]
    write(comm, tmp_path / "f.h5", *starts[comm.rank:comm.rank + 2])
    with open_product(comm, tmp_path / "f.h5", "ground_truth") as file:
        series = FieldSeries(file, "filtered")
        assert np.array_equal(series.times, [0, 0.1])
        assert series.cells == CELLS and set(series.variables) == VARIABLES.keys()
        for index in range(2):
            for name in VARIABLES:
                assert np.array_equal(series.read(index, name), field(index, name).astype(np.float32))
        planes = series.read(1, "velocity", 2, 4)
        assert np.array_equal(planes, field(1, "velocity")[:, 2:4].astype(np.float32))
        with pytest.raises(ProductError, match="holds no fields/truth"):
            FieldSeries(file, "truth")


@pytest.mark.mpi(1)
@pytest.mark.parametrize("change, message", [
    (lambda group: group["time"].write_direct(np.array([0.1, 0.1])), "do not increase"),
    (lambda group: group["time"].resize(1, 0), r"shape \(2, ., 6, 6, 6\).* 1 times"),
    (lambda group: group.attrs.modify("cells", 8), r"shape \(2, ., 6, 6, 6\).* 8 cells")])
def test_malformed_series_are_refused(comm, tmp_path, change, message):
    write(comm, tmp_path / "f.h5")
    with changed(tmp_path / "f.h5") as file:
        change(file["fields/filtered"])
    with open_product(comm, tmp_path / "f.h5", "ground_truth") as file, pytest.raises(ProductError, match=message):
        FieldSeries(file, "filtered").times
