"""Cost of the parts of a scene: times with and without each part. Takes about a minute.

    python mpi_tools/launch.py -n 1 -- python tests/benchmarks/leave_out.py [--repetitions 20]

Prints a Markdown table: median milliseconds and messages of a call, with the part and without. Both calls of a pair are
measured in turn, so that they see the same load of the machine.
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from mpi4py import MPI

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent / "validation"), str(HERE.parents[1])]

from test_leave_out import combined_step, fluid_of, particle_step  # noqa: E402

from eddies.scene.terms import PRESETS  # noqa: E402
from tests.parallel.counting import CountingComm  # noqa: E402
from tests.particles.configurations import OWN_DENSITY  # noqa: E402

Call = tuple[Callable[[], object], list]  # a function to measure, and the list of its messages


def step_of(comm, terms) -> Call:
    counting = CountingComm(comm)
    return particle_step(counting, terms), counting.sent


def evaluation_of(comm, compressible: bool, forced: bool) -> Call:
    counting = CountingComm(comm)
    fluid, state = fluid_of(counting, compressible, forced)
    return lambda: fluid.nonlinear(state), counting.sent


def pairs_of_calls(comm) -> dict[str, tuple[Call, Call]]:
    """For each part the call with it and the call without it."""
    everything = {"field": 1.0, "velocity_kl": 0.1, "acceleration_kl": 0.1}
    without = {name: {key: weight for key, weight in everything.items() if key != name} for name in everything}
    pressure, resolved, learned = {"pressure": {}, "pairs": {}}, PRESETS["resolved"], OWN_DENSITY
    stress = {**resolved, "pairs": {}}  # the pairs read densities, as beside the pressure alone
    steps = {
        "pair force": (learned, {}),
        "pressure and its force": (pressure, learned),
        "stress, viscosity, damping and relaxation": (stress, pressure),
        "pair sum beside them": (stress, resolved),
        "eddy viscosity": (pressure | {"eddy-viscosity": {}}, pressure),
        "forcing of the particles": (pressure | {"injection": {"injection_rate": 0.5}}, pressure),
    }
    found = {f"step: {name}": tuple(step_of(comm, terms) for terms in pair) for name, pair in steps.items()}
    for name, others in without.items():
        found[f"training: {name.replace('_', ' ')} loss"] = combined_step(comm, **everything), combined_step(
            comm, **others)
    found["flow: density"] = evaluation_of(comm, True, False), evaluation_of(comm, False, False)
    found["flow: forcing"] = evaluation_of(comm, False, True), evaluation_of(comm, False, False)
    return found


def measure(comm, pair: tuple[Call, Call], repetitions: int) -> list[tuple[float, int]]:
    """Median seconds and number of messages of both calls."""
    seconds, messages = [[], []], [0, 0]
    for _ in range(repetitions):
        for index, (call, sent) in enumerate(pair):
            comm.Barrier()
            sent.clear()
            began = time.perf_counter()
            call()
            seconds[index].append(time.perf_counter() - began)
            messages[index] = len(sent)
    return [(float(np.median(times)), count) for times, count in zip(seconds, messages)]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=20)
    repetitions, comm = parser.parse_args().repetitions, MPI.COMM_WORLD
    rows = [(name, *measure(comm, pair, repetitions)) for name, pair in pairs_of_calls(comm).items()]
    if comm.rank == 0:
        print(f"| part, on {comm.size} rank(s) | with (ms) | without (ms) | messages with | without |",
              "|---|---|---|---|---|", sep="\n")
        for name, (with_it, sent), (without_it, fewer) in rows:
            print(f"| {name} | {1e3 * with_it:.3g} | {1e3 * without_it:.3g} | {sent} | {fewer} |")


if __name__ == "__main__":
    main()
