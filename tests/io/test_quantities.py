"""Products say their units, axes and origin of time."""

from collections import Counter

import h5py
import pytest

from eddies.io.hdf5 import create_product, growing_dataset, write_table
from eddies.io.quantities import dataset_attributes, python_value


@pytest.mark.mpi(1)
def test_a_dataset_of_ones_own_is_written_as_it_is(comm, tmp_path):
    with create_product(comm, tmp_path / "own.h5", "rollout", {}) as file:
        write_table(file, "mine", {"number": [1.0, 2.0]})
        growing_dataset(file, "series", (3,), float)
    with h5py.File(tmp_path / "own.h5") as file:
        assert not file["mine/number"].attrs and not file["series"].attrs


@pytest.mark.mpi(1)
def test_a_flow_says_its_units_its_box_and_what_t_0_is(comm, tmp_path):
    """A kernel has none of these."""
    names = {"units", "box", "time_origin"}
    for kind, origin in (("ground_truth", "released_at"), ("rollout", "start_time"), ("kernel", None)):
        with create_product(comm, tmp_path / f"{kind}.h5", kind, {}):
            pass
        with h5py.File(tmp_path / f"{kind}.h5") as file:
            assert names & set(file.attrs) == (names if origin else set())
            assert origin is None or origin in python_value(file.attrs["time_origin"])


def dimensions(*paths):
    """The powers of L, T and M in the unit of a product of datasets of a ground truth; each may have a power of its
    own, path^2."""
    powers = Counter()
    for path in paths:
        path, _, power = path.partition("^")
        for place, part in enumerate(dataset_attributes("ground_truth", path)["units"].split("/")):
            name, _, own = part.partition("^")
            powers[name] += (-1 if place else 1) * int(own or 1) * int(power or 1)
    return {name: power for name, power in powers.items() if name != "1" and power}


SAME_UNITS = [
    (["particles/tracers/position/value"], ["particles/tracers/velocity/value", "statistics/time"]),
    (["particles/tracers/velocity/value"], ["particles/tracers/acceleration/value", "statistics/time"]),
    (["fields/filtered/velocity^2"], ["statistics/energy"]), (["spectra/energy"], ["statistics/energy"]),
    (["statistics/energy"], ["statistics/dissipation_rate", "statistics/time"]),
    (["statistics/dissipation_rate"], ["statistics/injection_rate"]),
    (["statistics/integral_scale"], ["statistics/velocity_rms", "statistics/eddy_turnover_time"]),
    (["statistics/kolmogorov_length^2"], ["statistics/dissipation_rate", "statistics/kolmogorov_time^3"]),
    (["statistics/taylor_scale"], ["statistics/kolmogorov_length"]),
    (["statistics/density_rms"], ["fields/filtered/density"]),
    (["particles/tracers/velocity/value"], ["gradients/model/velocity_gradient", "particles/tracers/position/value"])]


def test_units_are_those_of_the_equations():
    for one, other in SAME_UNITS:
        assert dimensions(*one) == dimensions(*other) != {}, one
