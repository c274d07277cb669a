"""Stiff and extreme particles: what should happen, and what happens. A script, about a minute long.

    python tests/validation/extreme_particles.py [--output runs/validation]

Prints a Markdown table and writes it as extreme_particles.json. On two ranks or more it shows what they say together.
"""

import argparse
import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path

import torch
from mpi4py import MPI

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from extreme_cases import ARRANGEMENTS, CLOSURES, TOTAL, random_points, scales  # noqa: E402
from test_extreme_placements import (  # noqa: E402
    SEPARATIONS, arrangement, few_particles, lattice_at_rest, nearly_coincident, pushed_by_the_grid,
)
from test_extreme_states import (  # noqa: E402
    MACH_NUMBERS, at_mach_number, broken_step, density_contrast, momentum_gained, overdriven, precision_error,
    translated_run, translation,
)
from test_extreme_steps import (  # noqa: E402
    NEIGHBORS, SYSTEMS, amplification, boundary, gradient_error, measured_boundary,
)

from eddies.particles.integrators import INTEGRATORS  # noqa: E402

Row = tuple[str, str, str]  # what is done, what should happen, what happens


def placements(comm) -> Iterator[Row]:
    """Where particles are."""
    for kind in CLOSURES:
        found = [nearly_coincident(comm, kind, separation) for separation in SEPARATIONS]
        yield (f"twins 0, 1e-300, 1e-16, 1e-8 of a spacing apart; {kind}", "accelerations of coincident ones, finite",
               f"relative differences {', '.join(f'{difference:.0e}' for difference, _ in found)}; "
               f"{ending(all(sound for _, sound in found))}")
    for name in ARRANGEMENTS:
        for kind in CLOSURES:
            difference, sound = arrangement(comm, kind, name)
            yield (f"{TOTAL} particles {name}; {kind}", "finite, the same on all ranks",
                   f"difference to one rank {difference:.0e}; {ending(sound)}")
    for total in sorted({1, comm.size}):
        for kind in CLOSURES:
            off = max(few_particles(comm, kind, integrator, total) for integrator in INTEGRATORS)
            pushed = total > 1 and pushed_by_the_grid(kind)
            wanted = "pushed by the pressure on the grid alone" if pushed else "straight on"
            yield f"{total} particle(s) on {comm.size} rank(s); {kind}", wanted, f"off a straight line by {off:.0e}"
    for kind in CLOSURES:
        speeds = [lattice_at_rest(comm, kind, dtype) for dtype in (torch.float64, torch.float32)]
        yield (f"a lattice at rest; {kind}", "at rest to round-off, float64 and float32",
               "speed over step times a_rms: " + ", ".join(f"{speed:.0e}" for speed in speeds))


def states(comm) -> Iterator[Row]:
    """How particles move, and what they are."""
    fast = 1000 * scales(TOTAL).sound_speed
    for kind in CLOSURES:
        yield (f"moving at 1000 c; {kind}", "forces as at rest but for round-off",
               f"relative change {translation(comm, kind, fast, random_points(TOTAL)):.0e}")
        worst = max(translation(comm, kind, fast, place(TOTAL)) for place in ARRANGEMENTS.values())
        yield (f"the same, {TOTAL} particles in any of the arrangements above; {kind}", "the same",
               f"relative change {worst:.0e}")
        gained = max(momentum_gained(comm, kind, place(TOTAL)) for name, place in ARRANGEMENTS.items()
                     if name != "all at one point")  # where all forces are zero
        yield (f"sum of all forces, pairs antisymmetric, in any arrangement; {kind}", "zero to round-off",
               f"{gained:.0e} of the sum of their sizes")
    for step in (1e-5, 1e-4, 1e-2):
        yield (f"two steps of {step:g} at 1000 c, {comm.size} rank(s)", "as at rest, or refused by all ranks",
               shown(translated_run(comm, "own density", fast, step)))
    for kind, factors in (("pressure", (0.2,)), ("own density", (0.1, 20.0))):
        for mach in MACH_NUMBERS:
            for factor in factors:
                step = 0.02 if kind.startswith("pressure") else factor * mach
                complaint, velocity = at_mach_number(comm, kind, mach, step)
                yield (f"M_t {mach:g}, 20 steps of {step:g}; {kind}",
                       "says what failed" if factor > 1 else "finite",
                       complaint or f"largest speed {float(velocity.abs().max()):.4f}")
    for kind in CLOSURES:
        yield (f"density contrast 1000:1; {kind}", "bounded", f"{density_contrast(comm, kind, 1000.0):.2g} a_rms")
        yield (f"20 steps in float32; {kind}", "float64 to round-off", f"{precision_error(comm, kind, 20):.1e}")
    for rate in (1.0, 10.0):
        yield (f"injection {rate:g}", "that much energy", f"{overdriven(comm, rate):.9f} of it")
    for value in (math.nan, 1e200):
        told = broken_step(comm, "pressure", "rk4", value, 2)
        yield (f"a force of {value:g} in a stage of rk4", "all ranks say where",
               told[0] if len(set(told)) == 1 else f"ranks differ: {told}")


def steps() -> Iterator[Row]:
    """Sums over neighbours, and how long a step may be. On one rank."""
    for neighbors in NEIGHBORS:
        yield (f"{neighbors} neighbours", "-c^2 grad rho of a linear density to 1e-3",
               f"median error {gradient_error(neighbors)[0]:.2e}")
    for integrator in INTEGRATORS:
        for system in SYSTEMS:
            limit = boundary(integrator, system, 0.01)
            found = measured_boundary(integrator, system, 0.01)
            growth = SYSTEMS[system](integrator, 1.03 * limit)
            yield (f"{integrator}, {system}: the step times its rate that grows by 1 %", f"{limit:.4f}",
                   f"{found:.4f}; 3 % beyond {growth:.4f} a step "
                   f"(theory {amplification(integrator, system, 1.03 * limit):.4f})")


def ending(sound: bool) -> str:
    return "finite" if sound else "NOT FINITE"


def shown(result: float | str) -> str:
    return result if isinstance(result, str) else f"velocities differ by {result:.0e}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("runs/validation"))
    output, comm = parser.parse_args().output, MPI.COMM_WORLD
    rows = [*placements(comm), *states(comm), *(steps() if comm.rank == 0 else ())]
    if comm.rank == 0:
        output.mkdir(parents=True, exist_ok=True)
        names = ("case", "expected", "found")
        (output / "extreme_particles.json").write_text(json.dumps([dict(zip(names, row)) for row in rows], indent=1))
        print("| what was done | what should happen | what happened |", "|---|---|---|", sep="\n")
        for row in rows:
            print("|", " | ".join(row), "|")


if __name__ == "__main__":
    main()
