"""Products that tests of one job share: made once on each number of ranks, and linked into the directories of tests."""

import shutil
import tempfile
from pathlib import Path

import pytest

from tests.workflows.small_rollout import prepared, scales_of, write_model


@pytest.fixture(scope="session")
def shared_folder(comm):
    """A function that returns a new folder, the same on all ranks, for the products of the job."""
    folders = []

    def new():
        folders.append(Path(comm.bcast(tempfile.mkdtemp() if comm.rank == 0 else None)))
        return folders[-1]

    yield new
    comm.Barrier()
    for folder in folders if comm.rank == 0 else ():
        shutil.rmtree(folder)


@pytest.fixture(scope="session")
def small_products(comm, shared_folder):
    """The small scene, and a folder with its ground truth, untrained kernel and untrained model. Half of the inputs of
    the model are outside the range of its training."""
    folder = shared_folder()
    scene = prepared(comm, folder)
    write_model(comm, folder, scene, scales_of(comm, folder), 0.5)
    comm.Barrier()
    return scene, folder


@pytest.fixture
def linked(comm, tmp_path):
    """A function that links the products of folders into the directory of the test, and returns it."""
    def link(*paths):
        for path in paths if comm.rank == 0 else ():
            for product in path.iterdir() if path.is_dir() else [path]:
                if product.suffix in (".h5", ".toml"):
                    (tmp_path / product.name).symlink_to(product)
        comm.Barrier()
        return tmp_path

    return link
