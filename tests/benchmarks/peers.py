"""Parts of the package against other libraries, on the same data, to the same accuracy and in one run.

    OMP_NUM_THREADS=1 .venv/bin/python tests/benchmarks/peers.py splines [64] [--threads T]    # FINUFFT
    OMP_NUM_THREADS=1 .venv/bin/python tests/benchmarks/peers.py neighbors [64]                # vesin
    mpirun -n 2 .venv/bin/python tests/benchmarks/peers.py transforms [64 128]                 # mpi4py-fft

The numbers are particles or points a side, or cells. Prints JSON lines with medians of seconds. The libraries come by
`pip install --no-binary finufft,vesin finufft vesin mpi4py-fft`; the last one needs FFTW's headers.

splines: values of a velocity at points, and their adjoint, by the closure's splines. FINUFFT gets its best settings:
single precision, measured plans that are used again, and the fastest of several grids and of three or two transforms at
once; the first of two holds two components as real and imaginary part. Its time excludes this packing and the
additional modes kx < 0 that it needs. The velocity has the spectrum that the closure expects (`ResolvedVelocity`).
Errors are relative to exact sums at some points and in some modes, weighted by that spectrum. FINUFFT's tolerance is
the largest with an error not above that of the splines. "interpolation" goes from modes to points, "spreading" from
points to modes, each as a whole and between grid and points alone (FINUFFT's `spreadinterponly` with the same grid and
tolerance).

neighbors: all neighbours of random points in a periodic box, both orders of each pair, in double precision on one
thread. vesin gives the two numbers of each pair, in no order, in memory of its own; ours come in compressed rows.

transforms: forward and backward transforms of three components. mpi4py-fft transforms all modes, and those beyond the
2/3 rule are set to zero between the two transforms. Its plans are measured, its default. Ours drop these modes on the
way.
"""

import argparse
import json
import math
from collections.abc import Callable

import numpy as np
import torch
from mpi4py import MPI
from step import in_turn

from eddies.parallel.slab import SlabDecomposition
from eddies.particles.fourier_grid import FourierGrid
from eddies.particles.neighborhood import NeighborList
from eddies.particles.periodic_box import PeriodicBox
from eddies.particles.resolved_velocity import ResolvedVelocity
from eddies.spectral.spectral_grid import SpectralGrid

LENGTH = 2 * math.pi
NEIGHBORS = 60
PLANES, HIGHEST, CHECKED = 1.75, 0.75, 100
UPSAMPLING = (1.15, 1.23, 1.25)  # the first is the least that FINUFFT allows; 2, its other standard, takes far longer
TOLERANCES = [10 ** (-i / 6) for i in range(6, 30)]
MEASURE = 0                      # FFTW's flag

Action = Callable[[], np.ndarray]


class Case:
    """Points, a velocity with its values there and its modes, and exact sums."""

    def __init__(self, side: int) -> None:
        slab = SlabDecomposition(MPI.COMM_SELF, LENGTH, int(PLANES * side))
        self.grid, random = FourierGrid(slab, int(HIGHEST * side), 1, torch.float32), np.random.default_rng(1)
        self.position = random.uniform(0, slab.length, (side**3, 3))
        self.points = self.grid.points(torch.from_numpy(self.position))
        equations = ResolvedVelocity(self.grid, 2 * slab.length / side).equations
        penalty = equations.penalty.numpy()
        self.energy = np.divide(1, penalty, out=np.zeros_like(penalty), where=penalty > 0)
        noise = random.standard_normal((3, *self.grid.spectral.physical_shape), np.float32)
        self.modes = equations.projected(self.grid.to_modes(torch.from_numpy(noise))
                                         * torch.from_numpy(np.sqrt(self.energy / self.energy.max())))
        self.values = self.grid.at(self.modes, self.points)
        self.checked = random.integers(0, side**3, CHECKED)
        self.shells = self._modes_of_all_shells(random)
        self.exact = {"interpolation": self._exact_values(), "spreading": self._exact_modes()}

    def _modes_of_all_shells(self, random: np.random.Generator) -> np.ndarray:
        """Some modes (kz, ky, kx) with evenly spread |k|."""
        direction = random.standard_normal((CHECKED, 3))
        direction /= np.linalg.norm(direction, axis=1)[:, None] * np.sign(direction[:, 2:])
        return np.rint(direction * random.uniform(1, self.grid.resolved - 1, (CHECKED, 1))).astype(int)

    def _exact_values(self) -> np.ndarray:
        """Values (points, 3)."""
        total = self.grid.spectral.multiplicity * self.modes.numpy().astype(complex)
        kx, ky, kz = (axis.numpy().ravel().astype(float) for axis in self.grid.wavevector)
        x, y, z = self.position[self.checked].T
        waves = [np.exp(1j * np.outer(k, at)) for k, at in ((kz, z), (ky, y), (kx, x))]
        return np.einsum("czyp,zp,yp->pc", total @ waves[2], *waves[:2], optimize=True).real

    def _exact_modes(self) -> np.ndarray:
        """Modes (3, modes)."""
        return np.stack([self.values.numpy().T @ np.exp(-1j * (self.position @ mode[::-1])) for mode in self.shells], 1)

    def error(self, name: str, result: np.ndarray) -> float:
        """Relative error of values (n, 3) or of modes (3, kz, ky, kx)."""
        exact = self.exact[name]
        if name == "interpolation":
            return float(np.linalg.norm(result[self.checked] - exact) / np.linalg.norm(exact))
        place = tuple(self.shells.T)
        weight = np.sqrt(self.energy[place] * (self.shells**2).sum(1))
        return float(np.linalg.norm(weight * (result[:, *place] - exact)) / np.linalg.norm(weight * exact))


def ours(case: Case) -> dict[str, tuple[Action, Action]]:
    """Interpolation and spreading, each as a whole and between grid and points."""
    grid, points = case.grid, case.points
    fields, count = grid.to_fields(case.modes * grid.prefilter), grid.spectral.cells**3
    return {"interpolation": (lambda: grid.at(case.modes, points).numpy(),
                              lambda: points.at(points.spline.with_ghosts(fields.numpy()))),
            "spreading": (lambda: grid.spread(case.values, points).numpy() * np.float32(count),
                          lambda: points.spread(case.values))}


class Peer:
    """FINUFFT in one of its forms."""

    def __init__(self, case: Case, threads: int, name: str, packed: bool, upsampling: float) -> None:
        self.case, self.name, self.packed, self.upsampling, self.threads = case, name, packed, upsampling, threads
        self.size = 2 * case.grid.resolved + 1
        given = _all_kx(case.modes.numpy()) if name == "interpolation" else case.values.numpy().T
        self.given = np.ascontiguousarray(_pair(given) if packed else given, np.complex64)

    def whole(self, tolerance: float) -> Action:
        """The whole, from modes to points or back."""
        plan = self._plan(self.size, tolerance)
        return lambda: plan.execute(self.given)

    def part(self, tolerance: float) -> Action:
        """The part between its grid and points."""
        cells = _fine(self.upsampling * self.size)
        plan = self._plan(cells, tolerance, spreadinterponly=1)
        shape = (len(self.given), cells, cells, cells)
        given = np.ones(shape, np.complex64) if self.name == "interpolation" else self.given
        return lambda: plan.execute(given)

    def error(self, result: np.ndarray) -> float:
        """Error of the result of `whole`."""
        if self.name == "interpolation":
            pairs = [part for one in result for part in (one.real, one.imag)] if self.packed else result.real
            return self.case.error(self.name, np.stack(pairs[:3], 1))
        if self.packed:
            mirrored = np.roll(result[:, ::-1, ::-1, ::-1], 1, (1, 2, 3)).conj()
            first, second = (result + mirrored) / 2, (result - mirrored) / 2j
            result = np.stack([first[0], second[0], first[1]])
        return self.case.error(self.name, result)

    def _plan(self, size: int, tolerance: float, **options: int) -> object:
        kind, sign = (2, 1) if self.name == "interpolation" else (1, -1)
        from finufft import Plan
        plan = Plan(kind, (size,) * 3, len(self.given), tolerance, sign, "complex64", modeord=1, fftw=MEASURE,
                    upsampfac=self.upsampling, nthreads=self.threads, **options)
        plan.setpts(*(np.ascontiguousarray(x, np.float32) for x in self.case.position.T[::-1]))
        return plan


def _all_kx(modes: np.ndarray) -> np.ndarray:
    """Modes (c, kz, ky, kx) completed by those of kx < 0."""
    return np.concatenate([modes, np.roll(modes[:, ::-1, ::-1, :0:-1], 1, (1, 2)).conj()], 3)


def _pair(fields: np.ndarray) -> np.ndarray:
    return np.stack([fields[0] + 1j * fields[1], fields[2] + 0j])


def _fine(least: float) -> int:
    """The smallest even number from `least` on without prime factors above 5, FINUFFT's grid."""
    return next(n for n in range(2 * math.ceil(least / 2), 2 * math.ceil(least), 2) if 30**20 % n == 0)


def compare(case: Case, threads: int, name: str) -> list[dict[str, object]]:
    """Interpolation or spreading by both, with the fastest of FINUFFT's forms."""
    whole, part = ours(case)[name]
    error = case.error(name, whole())
    actions, parts, errors = {"eddies": whole}, {"eddies": part}, {"eddies": error}
    for form in (Peer(case, threads, name, packed, factor) for packed in (False, True) for factor in UPSAMPLING):
        tolerance = next(tolerance for tolerance in TOLERANCES if form.error(form.whole(tolerance)()) <= error)
        label = f"finufft: tolerance {tolerance:g}, grid of {form.upsampling}, {len(form.given)} transforms"
        actions[label], parts[label] = form.whole(tolerance), form.part(tolerance)
        errors[label] = form.error(actions[label]())
    both = in_turn(actions | {f"part {label}": action for label, action in parts.items()})
    found, count = [], len(case.position)
    for who in ("eddies", "finufft"):
        labels = [label for label in actions if label.startswith(who)]
        best, alone = (min(labels, key=lambda label: both[part + label]) for part in ("", "part "))
        found.append({"by": best, "error": errors[best], "seconds": both[best],
                      "points_per_second": count / both[best], "between_grid_and_points_by": alone,
                      "between_grid_and_points_per_second": count / both["part " + alone]})
    return found


def rows(points: torch.Tensor, cutoff: float) -> tuple[np.ndarray, np.ndarray]:
    """Compressed rows."""
    found = NeighborList(PeriodicBox(LENGTH, True), cutoff, 0.0)
    found.build(points, points, exclude_self=True)
    return found.offsets.numpy(), found.senders.numpy()


def peer_transform(comm: MPI.Comm, grid: SpectralGrid, field: np.ndarray) -> Callable[[], np.ndarray]:
    """The same round trip by mpi4py-fft, also with slabs along z."""
    from mpi4py_fft import PFFT, newDistArray
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


def splines(side: int) -> None:
    from finufft import __version__
    threads = torch.get_num_threads()
    with torch.no_grad():
        case = Case(side)
        for name in ("interpolation", "spreading"):
            for found in compare(case, threads, name):
                about = {"particles": side, "threads": threads, "finufft": __version__, "what": name}
                print(json.dumps(about | found), flush=True)


def neighbors(side: int) -> None:
    import vesin
    position = np.random.default_rng(1).uniform(0, LENGTH, (side**3, 3))
    points, box = torch.from_numpy(position), LENGTH * np.eye(3)
    cutoff = LENGTH / side * (NEIGHBORS * 3 / (4 * math.pi)) ** (1 / 3)
    peer = vesin.NeighborList(cutoff=cutoff, full_list=True, n_threads=1)
    actions: dict[str, Callable[[], tuple[np.ndarray, np.ndarray]]] = {
        "eddies": lambda: rows(points, cutoff),
        "vesin": lambda: peer.compute(position, box, True, "ij", copy=False)}
    offsets, senders = actions["eddies"]()
    ours = np.sort(np.repeat(np.arange(len(position)), np.diff(offsets)) * len(position) + senders)
    first, second = (index.astype(np.int64) for index in actions["vesin"]())
    if not np.array_equal(ours, np.sort(first * len(position) + second)):
        raise SystemExit("neighbors: the lists differ")
    middle = in_turn(actions)
    print(json.dumps({"points": side, "neighbors": len(senders) / len(position), "seconds": middle,
                      "nanoseconds_per_pair": 1e9 * middle["eddies"] / len(senders),
                      "ratio": middle["vesin"] / middle["eddies"]}))


def transforms(cells: int) -> None:
    comm = MPI.COMM_WORLD
    for precision in ("float64", "float32"):
        grid = SpectralGrid(SlabDecomposition(comm, LENGTH, cells), precision)
        field = np.random.default_rng(comm.rank).standard_normal((3, *grid.physical_shape)).astype(grid.real)
        round_trips = {"eddies": lambda: grid.backward(grid.forward(field)),
                       "mpi4py-fft": peer_transform(comm, grid, field)}
        ours, theirs = (round_trip() for round_trip in round_trips.values())
        difference = comm.allreduce(float(np.abs(ours - theirs).max()), MPI.MAX)
        middle = in_turn({name: lambda round_trip=round_trip: (round_trip(), comm.Barrier())
                          for name, round_trip in round_trips.items()}, rounds=15)
        if comm.rank == 0:
            print(json.dumps({"cells": cells, "precision": precision, "ranks": comm.size, "seconds": middle,
                              "ratio": middle["mpi4py-fft"] / middle["eddies"], "difference": difference}), flush=True)


PARTS = {"splines": splines, "neighbors": neighbors, "transforms": transforms}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=PARTS)
    parser.add_argument("sizes", nargs="*", type=int, default=[64])
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    for size in options.sizes:
        PARTS[options.what](size)


if __name__ == "__main__":
    main()
