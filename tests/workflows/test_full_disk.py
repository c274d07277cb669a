"""A direct simulation on a disk that is full at its beginning, in a frame, and at its end; then it continues."""

import pytest

from eddies.io import new_files
from eddies.io.errors import WriteError
from eddies.parallel.stop import StopRequest, Stopped
from eddies.scene.scene import load_scene
from eddies.workflows import dns
from tests.full_disk import largest_file
from tests.small_scene import TINY
from tests.workflows.contents import assert_same
from tests.workflows.stopping import StopAtStep
from tests.workflows.test_dns_restart import SPLIT, product


@pytest.mark.mpi(2, timeout=60)
def test_a_simulation_without_room_keeps_its_checkpoint_and_goes_on(comm, tmp_path, monkeypatch):
    """In place of a full disk the last rank may write so many bytes to a file."""
    monkeypatch.setattr(new_files, "MARGIN_BYTES", 2**12)
    scene = load_scene(TINY, SPLIT)
    run, whole, files = tmp_path / "run", tmp_path / "whole", []
    for path in (run, whole):
        path.mkdir(exist_ok=True)
    dns.run(scene, comm, whole)
    with pytest.raises(Stopped):
        dns.run(scene, comm, run, StopAtStep(comm, 11))
    comm.Barrier()
    before = {path: path.read_bytes() for path in run.rglob("step-*")}
    assert before
    comm.Barrier()
    for kilobytes in (1, 100, 400):
        with largest_file(comm, kilobytes * 1024, comm.size - 1), pytest.raises(WriteError, match="make room") as error:
            dns.run(scene, comm, run, StopRequest(comm))
        files.append(str(error.value).split(":")[0].split("/")[-1])
        comm.Barrier()
        assert all(path.read_bytes() == content for path, content in before.items())
        assert not list(run.rglob("*.partial")) and not (run / "ground_truth.h5").exists()
        comm.Barrier()
    assert files == ["ground_truth.h5.partial", "frames-00000014.h5.partial", "ground_truth.h5.partial"]
    dns.run(scene, comm, run)
    assert_same(product(comm, run), product(comm, whole))
