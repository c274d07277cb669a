"""Files that are written whole or not at all."""

import resource

import pytest

from eddies.errors import UserError
from eddies.io.hdf5 import in_files
from eddies.io.whole_files import write_files


@pytest.mark.mpi(1, 2)
def test_all_files_are_written(comm, tmp_path):
    in_files(comm, tmp_path, lambda: write_files({tmp_path / "a.txt": "ä", tmp_path / "b.png": b"\0\1"}))
    assert (tmp_path / "a.txt").read_text(encoding="utf-8") == "ä" and (tmp_path / "b.png").read_bytes() == b"\0\1"


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("limit", [0, 1, 5000])
def test_a_full_disk_leaves_what_was_there(comm, tmp_path, limit):
    """The second file is too long: of the first nothing is seen either."""
    names = ("page.html", "metrics.json")
    if comm.rank == 0:
        for name in names:
            (tmp_path / name).write_text("older")
    comm.Barrier()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        with pytest.raises(UserError, match=r"(metrics.json|page.html): cannot be written: File too large: 7007 bytes "
                                            r"wanted, \d+ free; make room, then run the command again"):
            in_files(comm, tmp_path, lambda: write_files({tmp_path / names[0]: "new" * 2 + "!",
                                                          tmp_path / names[1]: "x" * 7000}))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(names)
    assert {(tmp_path / name).read_text() for name in names} == {"older"}
