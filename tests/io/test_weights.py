"""Weights: read back as written, and refused when they are not."""

import numpy as np
import pytest

from eddies.io.hdf5 import ProductError
from eddies.io.weights import load_weights, save_weights
from tests.changed_product import changed

DESCRIPTION = {"basis": "corrected", "hidden": [16, 16], "scales": {"filter_width": 0.39}}


def tensors():
    random = np.random.default_rng(1)
    return {"layers.0.weight": random.random((3, 5)).astype(np.float32), "layers.0.bias": random.random(3),
            "scale": np.array(2.5), "none": np.zeros((0, 4))}


def save(comm, path):
    save_weights(comm, path, "model", DESCRIPTION, tensors(), {"fingerprint": "abc"},
                 {"history": {"step": np.arange(4), "loss": np.ones(4)}})


@pytest.mark.mpi(2)
def test_weights_survive(comm, tmp_path):
    save(comm, tmp_path / "m.h5")
    stored = load_weights(comm, tmp_path / "m.h5", "model")
    assert stored.description == DESCRIPTION and stored.provenance["fingerprint"] == "abc"
    assert stored.weights.keys() == tensors().keys()
    for name, tensor in tensors().items():
        assert stored.weights[name].dtype == tensor.dtype and np.array_equal(stored.weights[name], tensor)
    assert stored.tables.keys() == {"history"} and np.array_equal(stored.tables["history"]["step"], np.arange(4))


@pytest.mark.mpi(2)
def test_tensors_that_are_not_finite_are_neither_written_nor_read(comm, tmp_path, monkeypatch):
    tensors = {"scale": np.array([1.0, np.nan])}
    with pytest.raises(ProductError, match="m.h5: tensor scale is not finite"):
        save_weights(comm, tmp_path / "m.h5", "model", {}, tensors, {})
    assert not list(tmp_path.iterdir())
    comm.Barrier()
    with monkeypatch.context() as patch:
        patch.setattr(np, "isfinite", lambda _: np.array(True))
        save_weights(comm, tmp_path / "m.h5", "model", {}, tensors, {})
    with pytest.raises(ProductError, match="tensor scale .*not finite"):
        load_weights(comm, tmp_path / "m.h5", "model")


@pytest.mark.mpi(1)
@pytest.mark.parametrize("value", ["nonsense {", 3])
def test_weights_without_a_description_are_refused(comm, tmp_path, value):
    save(comm, tmp_path / "m.h5")
    with changed(tmp_path / "m.h5") as file:
        file.attrs["description"] = value
    with pytest.raises(ProductError, match="m.h5: its attribute description"):
        load_weights(comm, tmp_path / "m.h5", "model")
