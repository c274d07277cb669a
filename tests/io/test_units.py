"""Products say their units, axes and origin of time."""

from collections import Counter

import h5py
import numpy as np
import pytest

from eddies.flow import history
from eddies.io import units
from eddies.io.hdf5 import Table, create_product, growing_dataset, open_product, read_table, write_table
from eddies.io.new_files import python_value


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


@pytest.mark.mpi(1)
def test_axes_and_units_of_a_table_survive_a_copy(comm, tmp_path):
    spectra = Table({"time": [0.0, 1.0], "wavenumber": np.arange(3), "energy": np.ones((2, 3)), "sum": [3.0, 3.0]},
                    "time wavenumber", {"time": "T", "energy": "L^2/T^2"})
    with create_product(comm, tmp_path / "first.h5", "rollout", {}) as file:
        write_table(file, "spectra", spectra)
        write_table(file, "mine", {"number": [1.0, 2.0]})
        growing_dataset(file, "series", (3,), float)
    with open_product(comm, tmp_path / "first.h5", "rollout") as file, \
            create_product(comm, tmp_path / "second.h5", "rollout", {}) as copy:
        write_table(copy, "spectra", read_table(file, "spectra"))
        assert words_of(file["mine/number"]) == {"axes": "row"} and not file["series"].attrs
    with h5py.File(tmp_path / "second.h5") as file:
        assert {name: words_of(dataset) for name, dataset in file["spectra"].items()} == {
            "time": {"axes": "time", "units": "T"}, "wavenumber": {"axes": "wavenumber"},
            "energy": {"axes": "time wavenumber", "units": "L^2/T^2"}, "sum": {"axes": "time"}}


def words_of(dataset):
    return {name: python_value(value) for name, value in dataset.attrs.items()}


def dimensions(product):
    """The powers of L, T and M in a product of quantities, each of which may have a power: "velocity^2 time"."""
    powers = Counter()
    for quantity in product.split():
        name, _, power = quantity.partition("^")
        for place, part in enumerate({**units.UNITS, **history.UNITS}[name].split("/")):
            base, _, own = part.partition("^")
            powers[base] += (-1 if place else 1) * int(own or 1) * int(power or 1)
    return {base: power for base, power in powers.items() if base != "1" and power}


@pytest.mark.parametrize("equation", [
    "position = velocity time", "velocity = acceleration time", "velocity = gradient position", "q = vorticity^2",
    "r = gradient^3", "pressure = velocity^2", "velocity^2 = energy", "energy = dissipation_rate time",
    "injection_rate = dissipation_rate", "integral_scale = velocity_rms eddy_turnover_time", "density_rms = density",
    "kolmogorov_length^2 = dissipation_rate kolmogorov_time^3", "taylor_scale = kolmogorov_length"])
def test_units_are_those_of_the_equations(equation):
    one, other = equation.split(" = ")
    assert dimensions(one) == dimensions(other) != {}
