"""The numbers of a product, which another run must repeat."""

import h5py
import numpy as np

from eddies.io.new_files import python_value


def numbers_in(comm, path):
    """All datasets and attributes below the root of a product, by path, except wall times and the load."""
    comm.Barrier()
    with h5py.File(path) as file:
        found = {name: value for key, item in file.items() for name, value in below(item, key)}
    comm.Barrier()
    of_the_machine = ("seconds", "storing_share", "surplus_load", "switches_per_step")
    return {name: value for name, value in found.items() if not any(word in name for word in of_the_machine)}


def below(item, name):
    """Yield path and value of a dataset, or of all attributes and datasets of a group."""
    if isinstance(item, h5py.Dataset):
        yield name, item[()]
        return
    yield from ((f"{name}/{key}", python_value(value)) for key, value in item.attrs.items())
    for key, part in item.items():
        yield from below(part, f"{name}/{key}")


def assert_same(found, expected, place=""):
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        assert np.array_equal(found[name], values, equal_nan=np.asarray(values).dtype.kind == "f"), (place, name)
