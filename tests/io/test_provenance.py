"""Provenance of a product: its id, and the ids of the products that it was made from."""

import json

import pytest

from eddies.io.hdf5 import create_product, open_product
from eddies.io.provenance import others_trained_on, product_provenance, read_provenance
from tests.changed_product import changed


def write(comm, directory, kind, *made_from):
    path = directory / f"{kind}.h5"
    with create_product(comm, path, kind, {"made_from": made_from}):
        pass
    with open_product(comm, path, kind) as file:
        return read_provenance(file)


@pytest.mark.mpi(2)
def test_a_product_has_an_id_of_its_own_and_those_of_what_it_was_made_from(comm, tmp_path):
    truth = write(comm, tmp_path, "ground_truth")
    model = write(comm, tmp_path, "model", "ground_truth", "kernel")
    again = write(comm, tmp_path, "ground_truth")
    assert all(len({*comm.allgather(found["id"])}) == 1 for found in (truth, model, again))
    assert len({truth["id"], model["id"], again["id"]}) == 3
    assert truth["made_from"] == {} and model["made_from"] == {"ground_truth": truth["id"]}


@pytest.mark.mpi(1)
def test_a_product_without_an_id_stays_readable(comm, tmp_path):
    """As one made before there were ids; what is made from it knows that it was one of those."""
    write(comm, tmp_path, "ground_truth")
    with changed(tmp_path / "ground_truth.h5") as file:
        origin = json.loads(file.attrs["provenance"])
        del origin["id"], origin["made_from"]
        file.attrs["provenance"] = json.dumps(origin)
    assert product_provenance(tmp_path / "ground_truth.h5") == origin
    assert write(comm, tmp_path, "kernel", "ground_truth")["made_from"] == {"ground_truth": None}


def test_a_model_that_was_trained_on_others_alone_says_so():
    own = {"made_from": {"ground_truth": "t1", "kernel": "k1"}}
    assert others_trained_on({**own, "truths": {"runs/other/ground_truth.h5": "t2"}}) == ["runs/other/ground_truth.h5"]
    both = {"runs/other/ground_truth.h5": "t2", "runs/own/ground_truth.h5": "t1"}
    for truths in ({}, {"truths": {}}, {"truths": both}):
        assert others_trained_on(own | truths) == []
