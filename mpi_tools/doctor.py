"""Print the libraries of every rank, and test messages between ranks and a file that all ranks write together.

    python mpi_tools/launch.py -- .venv/bin/python mpi_tools/doctor.py

Prints one line per rank, and its complaints. In a ring test every rank sends numbers to the next rank and checks those
that it receives. The exit code is the number of complaints, at most 100.
"""

import importlib
import os
import platform
import traceback
from pathlib import Path

from mpi4py import MPI
import numpy as np

RING_NUMBERS = 1 << 20
RING_ROUNDS = 20
# Variables with the number of ranks that a launcher has started. Of nested launchers, the innermost comes first.
STARTED = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "SLURM_STEP_NUM_TASKS")


def versions() -> tuple[str, list[str]]:
    """Return the versions of the libraries that eddies needs, and complaints about missing ones."""
    found, missing = [], []
    for name in ("numpy", "h5py", "pyfftw", "torch", "matplotlib"):
        try:
            module = importlib.import_module(name)
        except ImportError as error:
            missing.append(f"{name} cannot be imported ({error})")
            continue
        found.append(f"{name} {module.__version__}")
        if name == "h5py":
            parallel = module.get_config().mpi
            found[-1] += f" (HDF5 {module.version.hdf5_version}, {'mpio' if parallel else 'serial'})"
            if not parallel:
                missing.append("h5py without MPI: run mpi_tools/bootstrap.sh, or build it with HDF5_MPI=ON")
        elif name == "pyfftw":
            found[-1] += f" (FFTW {module.fftw_version})"
        elif name == "torch":
            found[-1] += f" ({module.get_num_threads()} threads, {accelerator(module)})"
    return ", ".join(found), missing


def accelerator(torch) -> str:
    """Return the number and the name of the GPUs of this host, or "no GPU"."""
    if not torch.cuda.is_available():
        return "no GPU"
    return f"{torch.cuda.device_count()} x {torch.cuda.get_device_name(0)}"


def unconnected(comm: MPI.Comm) -> list[str]:
    """Return a complaint if MPI does not connect all ranks that were started."""
    started = next((int(os.environ[name]) for name in STARTED if os.environ.get(name, "").isdecimal()), 0)
    return [f"{started} ranks were started, but MPI connects {comm.size} of them: start them with the mpirun of this "
            "MPI, or under Slurm with srun --mpi=pmix"] if started > comm.size else []


def ring_bandwidth(comm: MPI.Comm) -> tuple[float, list[str]]:
    """Return the bandwidth in bytes/s to the next rank while all ranks send, and complaints about wrong numbers."""
    above, below = (comm.rank + 1) % comm.size, (comm.rank - 1) % comm.size
    outgoing = comm.rank + np.arange(RING_NUMBERS, dtype=float)
    incoming = np.empty_like(outgoing)
    comm.Barrier()
    start = MPI.Wtime()
    for _ in range(RING_ROUNDS):
        comm.Sendrecv(outgoing, above, 0, incoming, below, 0)
    seconds = MPI.Wtime() - start
    wrong = np.count_nonzero(incoming != below + np.arange(RING_NUMBERS, dtype=float))
    complaints = [f"{wrong} of {RING_NUMBERS} numbers from rank {below} are wrong"] if wrong else []
    return RING_ROUNDS * outgoing.nbytes / seconds, complaints


def parallel_file(comm: MPI.Comm) -> list[str]:
    """Write a file in the current folder on all ranks together, and read it. Return complaints about its content."""
    import h5py
    path = Path(f"doctor-{comm.bcast(os.getpid())}.h5")  # a name of its own for each run, the same on all ranks
    with h5py.File(path, "w", driver="mpio", comm=comm) as file:
        rows = file.create_dataset("rank", (comm.size,), int)
        with rows.collective:
            rows[comm.rank] = comm.rank
    with h5py.File(path, "r", driver="mpio", comm=comm) as file:
        good = np.array_equal(file["rank"][:], np.arange(comm.size))
    comm.Barrier()
    if comm.rank == 0:
        path.unlink()
    return [] if good else ["a file written by all ranks together reads back wrong"]


def main() -> int:
    comm = MPI.COMM_WORLD
    libraries, complaints = versions()
    bandwidth, wrong = ring_bandwidth(comm)
    complaints += wrong + unconnected(comm)
    # A rank without parallel h5py would leave the others waiting in the collective calls.
    if comm.size > 1 and comm.allreduce(len(complaints)) == 0:
        complaints += parallel_file(comm)
    line = (f"rank {comm.rank} of {comm.size} on {platform.node()}: {len(os.sched_getaffinity(0))} cores, "
            f"OMP_NUM_THREADS {os.environ.get('OMP_NUM_THREADS', 'unset')}, "
            f"{MPI.Get_library_version().split(',')[0].strip()}, {libraries}, "
            f"{bandwidth / 1e9:.2f} GB/s to rank {(comm.rank + 1) % comm.size}")
    texts = comm.gather("\n".join([line, *(f"  rank {comm.rank}: {complaint}" for complaint in complaints)]))
    count = comm.allreduce(len(complaints))
    if comm.rank == 0:
        print(*texts, f"{count} complaints" if count else "all is well", sep="\n", flush=True)
    return min(count, 100)


if __name__ == "__main__":
    try:
        code = main()
    except Exception:  # on one rank; without Abort the others would wait for it forever
        traceback.print_exc()
        MPI.COMM_WORLD.Abort(1)
    raise SystemExit(code)
