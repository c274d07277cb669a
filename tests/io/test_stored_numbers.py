"""What a product holds in floating point: attributes, tables, and of series the last frame."""

import numpy as np
import pytest

from eddies.io.fields import FieldWriter
from eddies.io.hdf5 import create_product, open_product, write_attributes, write_table
from eddies.io.stored_numbers import stored_numbers
from eddies.io.trajectories import TrajectoryWriter


@pytest.mark.mpi(1)
def test_every_number_is_found_and_of_series_the_last_frame(comm, tmp_path):
    with create_product(comm, tmp_path / "a.h5", "rollout", {}) as file:
        write_table(file, "errors", {"delay": np.arange(3.0), "count": np.arange(3), "single": 0.5})
        write_attributes(file.create_group("rollout"), {"status": "complete", "turnovers": 1.5, "ranks": 2})
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
        "particles/model/box/edges": (None, 1), "particles/none/box/edges": (None, 1), "fields/model/velocity": (2, 2),
        "particles/model/velocity/value": (2, 2), "fields/model/time": (2, 0.2),
        **{place: (2, 0.2) for place in found if place.startswith("particles/model") and place.endswith("time")}}
