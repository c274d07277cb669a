"""Time of forward and backward transforms of three components, against mpi4py-fft on the same arrays.

    mpirun -n 2 .venv/bin/python tests/benchmarks/transforms.py [CELLS ...]

mpi4py-fft (pip install mpi4py-fft; it needs FFTW's headers) transforms all modes, and those beyond the 2/3 rule are set
to zero between the two transforms. Its plans are measured, its default. Ours drop these modes on the way.
"""

import sys
from collections.abc import Callable

import numpy as np
from mpi4py import MPI
from mpi4py_fft import PFFT, newDistArray
from step import in_turn

from eddies.parallel.slab import SlabDecomposition
from eddies.spectral.spectral_grid import SpectralGrid


def peer_transform(comm: MPI.Comm, grid: SpectralGrid, field: np.ndarray) -> Callable[[], np.ndarray]:
    """The same round trip by mpi4py-fft, also with slabs along z."""
    plan = PFFT(comm, [grid.cells] * 3, axes=(0, 1, 2), dtype=grid.real, grid=(-1,))
    given, modes, result = (newDistArray(plan, forward, rank=1) for forward in (False, True, False))
    given[:] = field
    signed = np.abs(np.fft.fftfreq(grid.cells, 1 / grid.cells))
    z, y, x = (axis[part] for axis, part in zip((signed, signed, np.arange(grid.cells // 2 + 1)),
                                                plan.local_slice(True)))
    kept = np.maximum(np.maximum(z[:, None, None], y[None, :, None]), x[None, None, :]) <= grid.cutoff

    def round_trip() -> np.ndarray:
        for component, spectral in zip(given, modes):
            plan.forward(component, spectral)
        np.multiply(modes, kept, out=modes)
        for spectral, component in zip(modes, result):
            plan.backward(spectral, component)
        return result

    return round_trip


def main() -> None:
    comm = MPI.COMM_WORLD
    for cells in [int(argument) for argument in sys.argv[1:]] or [64, 128]:
        for precision in ("float64", "float32"):
            grid = SpectralGrid(SlabDecomposition(comm, 2 * np.pi, cells), precision)
            field = np.random.default_rng(comm.rank).standard_normal((3, *grid.physical_shape)).astype(grid.real)
            round_trips = {"eddies": lambda: grid.backward(grid.forward(field)),
                           "mpi4py-fft": peer_transform(comm, grid, field)}
            ours, theirs = (round_trip() for round_trip in round_trips.values())
            difference = comm.allreduce(float(np.abs(ours - theirs).max()), MPI.MAX)
            middle = in_turn({name: lambda round_trip=round_trip: (round_trip(), comm.Barrier())
                              for name, round_trip in round_trips.items()}, rounds=15)
            if comm.rank == 0:
                print(f"{cells:4}^3  {precision}  {comm.size} ranks  "
                      + "  ".join(f"{name} {1e3 * value:.1f} ms" for name, value in middle.items())
                      + f"  ratio {middle['mpi4py-fft'] / middle['eddies']:.2f}  difference {difference:.0e}",
                      flush=True)


if __name__ == "__main__":
    main()
