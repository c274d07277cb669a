"""Where a product comes from: versions, commit, ranks and date, stored as JSON in every file."""

import datetime
import platform
from importlib import metadata
from pathlib import Path

import h5py
from mpi4py import MPI

import eddies
from eddies.kernels.library import in_use

LIBRARIES = ("numpy", "mpi4py", "h5py", "pyfftw", "torch")


def environment(ranks: int) -> dict[str, object]:
    """Versions of this package and its libraries, the commit in a checkout, number of ranks, date."""
    versions = {"python": platform.python_version(), "hdf5": h5py.version.hdf5_version,
                "mpi": MPI.Get_library_version().strip("\0 \n").split("\n")[0]}
    for library in LIBRARIES:
        try:
            versions[library] = metadata.version(library)
        except metadata.PackageNotFoundError:
            continue
    return {"eddies": eddies.__version__, "commit": commit(), "libraries": versions, "kernels": in_use(),
            "ranks": ranks, "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")}


def commit() -> str | None:
    """The git commit of the checkout this package runs from, or None; starts no process (MPI dislikes it)."""
    git = Path(eddies.__file__).parents[2] / ".git"
    try:
        head = (git / "HEAD").read_text().strip()
        if not head.startswith("ref: "):
            return head
        reference = head.removeprefix("ref: ")
        if (git / reference).exists():
            return (git / reference).read_text().strip()
        packed = (git / "packed-refs").read_text().splitlines()
    except OSError:
        return None
    return next((line.split()[0] for line in packed if line.endswith(f" {reference}")), None)
