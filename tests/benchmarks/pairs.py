"""Time of sums over pairs, search included, and of gradients by the parameters: the preset `paper` and a network 16-16.

    OMP_NUM_THREADS=1 .venv/bin/python tests/benchmarks/pairs.py [PARTICLES A SIDE] [LIBRARY ...]

Prints processor seconds, the least of several turns, for random particles with 60 neighbours in single precision, and
the seconds that 64^3 particles would take on two cores. Libraries, such as src/eddies/kernels/avx2.so, may come from
another version with the same calls. Results are compared with those of the first library.
"""

import argparse
import ctypes
import math
import time
from collections.abc import Callable

import numpy as np

from eddies.kernels import pairs as compiled
from eddies.kernels.library import in_use, load
from eddies.kernels.pairs import CompiledPairs, PairSpace, Summand

NEIGHBORS, REPEATS = 60, 7


def network(*widths: int) -> np.ndarray:
    """Random parameters of a network."""
    random = np.random.default_rng(widths)
    return np.concatenate([random.normal(scale=scale, size=size) for inputs, outputs in zip(widths, widths[1:])
                           for scale, size in ((inputs**-0.5, inputs * outputs), (0.1, outputs))])


def published(unit: float, *hidden: int) -> tuple[list[tuple[Summand, np.ndarray]], bool]:
    """The four sums of the published form, with or without `unit` vectors."""
    return [(Summand("pair-network", (2, 0, 1, 1, 1, 1, unit, 0, 0, *hidden), (-1.0,) * 6), network(5, *hidden, 2)),
            (Summand("eddy-viscosity", (2, 0.1, 0, unit, 1e-6 if unit else 1), (-1.0,) * 3), np.full(2, 0.1)),
            (Summand("pair-network", (1, 0, 1, 1, 1, 1, 0, 0, 1, *hidden), (-1.0,)), network(5, *hidden, 1)),
            (Summand("density-diffusion", (0.1, 0), (-1.0,)), np.full(2, 0.1))], False


# Summands with parameters, and whether each pair is evaluated once.
MODELS = {
    "paper": published(0, 20, 20, 20, 20),
    "paper-code": published(1, 20, 100, 20),
    "16-16": ([(Summand("pair-network", (2, 0, 0, 1, 1, 1, 0, 1, 0, 16, 16), (-1.0,) * 6),
                network(3, 16, 16, 2))], True),
}


def actions(side: int) -> dict[str, Callable[[], list[np.ndarray]]]:
    """The actions to time, by name."""
    random, count = np.random.default_rng(1), side**3
    radius = (NEIGHBORS / count * 3 / (4 * math.pi)) ** (1 / 3)
    columns = random.uniform(size=(count, 3)), random.normal(size=(count, 3)), random.normal(size=(1, count))
    found: dict[str, Callable[[], list[np.ndarray]]] = {}
    for name, (given, mutual) in MODELS.items():
        pairs = CompiledPairs(PairSpace(1.0, True, radius, radius, 1.0, mutual), *columns,
                              np.ones(count, bool), np.float32)
        summands, parameters = zip(*given)
        by = [random.normal(size=(len(one.parity), count)).astype(np.float32) for one in summands]
        found[f"{name}, sums"] = lambda p=pairs, s=summands, w=parameters: p.sums(s, w)
        found[f"{name}, gradients"] = lambda p=pairs, s=summands, w=parameters, by=by: p.gradients(s, w, by, False)[0]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("side", nargs="?", type=int, default=20)
    parser.add_argument("libraries", nargs="*")
    options = parser.parse_args()
    libraries = {path: ctypes.CDLL(path) for path in options.libraries} or {in_use(): load(in_use())}
    for name, action in actions(options.side).items():
        least, found = dict.fromkeys(libraries, math.inf), {}
        for _ in range(REPEATS):
            for path, library in libraries.items():
                compiled.library = lambda library=library: library
                start = time.process_time()
                found[path] = action()
                least[path] = min(least[path], time.process_time() - start)
        expected = found[next(iter(libraries))]
        for path, seconds in least.items():
            apart = max(np.abs(one - other).max() / np.abs(other).max() for one, other in zip(found[path], expected))
            print(f"{name:18} {seconds:.4f} s  64^3 on two cores {seconds * (64 / options.side)**3 / 2:.2f} s  "
                  f"differs by {apart:.0e}  {path}", flush=True)


if __name__ == "__main__":
    main()
