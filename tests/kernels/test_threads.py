"""Kernels give the same bits with any number of threads and from run to run."""

import hashlib
import json
import os
from pathlib import Path

import numpy as np

from eddies.kernels import library
from eddies.kernels.copies import ColumnCopies, Described, PlaneCopies
from eddies.kernels.kriging import kriging_weights
from eddies.kernels.pairs import CompiledPairs, PairSpace, Summand
from eddies.kernels.splines import Splines
from tests.commands import python
from tests.kernels import test_flow as flow
from tests.kernels import test_modes as modes
from tests.kernels.test_copies import noise
from tests.kernels.test_splines import parts, whole

CHECKOUT = Path(__file__).parents[2]
PROGRAM = ("import json\nfrom tests.kernels.test_threads import digests\n"
           "print(json.dumps([digests() for _ in range({})]))")


def copied():
    size = (144, 47, np.complex128)
    planes, columns = (kind(*size) for kind in (PlaneCopies, ColumnCopies))
    arrays = [noise(1, complex, 2, 4, 95, 48), noise(2, complex, 2, 144, 98), noise(3, complex, 144, 20, 48),
              noise(4, complex, 1, 95, 40, 48), noise(5, complex, 95)]
    blocks = planes.described_blocks(arrays[:1])
    rows, column, kept, factors = map(Described, arrays[1:])
    arrays.append(planes.pack(blocks, slice(0, 4)))
    for _ in planes.filled(arrays[-1], noise(5, complex, 1, 1, 95, 1), rows):
        planes.unpack(rows, blocks, 1, slice(0, 4))
    columns.store(column, 0.3, kept, 0, slice(7, 27))
    columns.fill(kept, 0, slice(9, 29), factors, column)
    yield from arrays


def formulas():
    for precision in ("float64", "float32"):
        grid, compiled = flow.set_up(precision, 60)
        out = flow.fields(4, (2, 60, 120), precision)
        compiled.advection(flow.fields(15, (2, 60, 120), precision), 0.3, out)
        yield out
        yield compiled.project(flow.modes(grid, 3))
        yield compiled.sum_of_acoustic_blocks([(flow.factors(grid, 5, seed), flow.modes(grid, 4, seed))
                                               for seed in (1, 2)])
        yield compiled.sum_of_decays([(flow.factors(grid, 1, 1), flow.modes(grid, 3))])


def mode_passes():
    for kind in (np.float64, np.float32):
        passes, _, inverse, vectors = modes.set_up((33, 17, 17), kind)
        sums, results = modes.run(passes, inverse, vectors)
        yield from (np.array(sums), *results.values())


def pair_sums():
    random = np.random.default_rng(1)
    position, velocity = random.uniform(0, 1, (5000, 3)), random.standard_normal((5000, 3))
    network = (2, 1, 1, 1, 1, 1, 0, 1, 0, 9, 6)
    summands = [Summand("pair-network", network, (-1.0,) * 6), Summand("moments", (), (1.0,) * 7)]
    parameters = [random.standard_normal(9 * 6 + 6 * 10 + 2 * 7), np.zeros(0)]
    for kind in (np.float32, np.float64):
        for mutual in (True, False):
            space = PairSpace(1.0, mutual, 0.13, 0.1, 1.0, mutual)
            pairs = CompiledPairs(space, position, velocity, random.standard_normal((1, 5000)),
                                  random.uniform(size=5000) < 0.9, kind)
            sums = pairs.sums(summands, parameters)
            by_parameters, by_columns = pairs.gradients(summands, parameters, sums, True)
            yield from (*sums, by_parameters[0], *by_columns)


def splines():
    """Threads of spreading meet, also on lattices with an odd number of lines."""
    random = np.random.default_rng(7)
    for degree, cells, kind in ((3, 41, "f8"), (5, 18, "f8"), (3, 11, "f8"), (3, 41, "f4"), (5, 41, "f4")):
        positions, values = random.uniform(0, 20, (30000, 3)), random.standard_normal((30000, 3))
        compiled, planes = Splines(degree, positions, *whole(cells)), parts(cells, kind=kind)
        compiled.spread(values, planes)
        yield from (compiled.at(planes), compiled.slope(planes, values), *planes)


def kriging():
    for kind in (np.float32, np.float64):
        random = np.random.default_rng(8)
        offsets = np.concatenate([[0], np.cumsum(random.integers(0, 40, 500))])
        displacement = random.uniform(-0.2, 0.2, (3, offsets[-1])).astype(kind)
        own, others = kriging_weights(offsets, displacement, 0.4, 1e-2, 2.0, np.array([0.7, 0.3]))
        yield from (own, *others)


INSTRUCTION_SETS = library.instruction_sets()
KERNELS = (copied, formulas, kriging, mode_passes, pair_sums, splines)


def digests():
    """Digests of all bits that a kernel returns, by kernel and instruction set."""
    bits = {}
    for name in INSTRUCTION_SETS:
        library.in_use = lambda name=name: name
        library.library.cache_clear()
        for kernel in KERNELS:
            digest = hashlib.sha256()
            for array in kernel():
                assert np.abs(array).max() > 0
                digest.update(array.tobytes())
            bits[f"{kernel.__name__} {name}"] = digest.hexdigest()
    return bits


def test_the_same_bits_with_any_number_of_threads_and_from_run_to_run():
    """With one thread, and twice with three."""
    [alone], several = (json.loads(python("-c", PROGRAM.format(runs), cwd=CHECKOUT, timeout=120, env={
        **os.environ, "OMP_NUM_THREADS": threads}).stdout) for threads, runs in (("1", 1), ("3", 2)))
    assert len(alone) == len(KERNELS) * len(INSTRUCTION_SETS)
    assert several == [alone, alone]
