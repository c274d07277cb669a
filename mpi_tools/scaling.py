"""Measure a step of the direct simulation on several numbers of ranks.

    .venv/bin/python mpi_tools/scaling.py [--cells 64 128] [--ranks 1 2]

The times come from tests/benchmarks/step.py, which compares each part with its bound. Speed-up and efficiency are
relative to the first of RANKS. `tests/benchmarks/projection.py flow` projects larger runs.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

CHECKOUT = Path(__file__).parents[1]
# Columns of the table, and the parts of the step's benchmark that each adds up.
GROUPS = {"transforms": ("plane transforms", "column transforms"),
          "transposes": ("transposes",),
          "pointwise": ("pairs of planes", "products", "linear operators", "the rest")}


def output_of(arguments: list[str], ranks: int = 0) -> str:
    """Return the output of a Python program, on some ranks or without MPI; CalledProcessError if it fails."""
    launcher = [sys.executable, CHECKOUT / "mpi_tools/launch.py", "-n", str(ranks), "--"] if ranks else []
    return subprocess.run([*launcher, sys.executable, *arguments], check=True, text=True,
                          stdout=subprocess.PIPE).stdout


def measured(cells: int, ranks: int, precision: str, steps: int) -> dict:
    """Return the result of the step's benchmark."""
    return json.loads(output_of([str(CHECKOUT / "tests/benchmarks/step.py"), str(cells), "--precision", precision,
                                 "--steps", str(steps), "--json"], ranks))


def row(result: dict, first: dict) -> str:
    """Return a line of the table, relative to the result on the first number of ranks."""
    speed_up = first["seconds_per_step"] / result["seconds_per_step"]
    shares = [sum(result["parts"][part] for part in parts) / result["seconds_per_step"] for parts in GROUPS.values()]
    return (f"{result['cells']:5} {result['precision']:>9} {result['ranks']:6} {result['seconds_per_step']:9.4f} "
            f"{speed_up:8.2f} {speed_up * first['ranks'] / result['ranks']:10.0%} "
            + " ".join(f"{share:10.0%}" for share in shares)
            + f" {result['memory_bytes'] / 1e6:9.0f} MB")


def positive(text: str) -> int:
    """Return a positive integer of the command line."""
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}: a positive integer is expected")
    return int(text)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", nargs="+", type=positive, default=[64, 128], help="cells along a side, measured")
    parser.add_argument("--ranks", nargs="+", type=positive, default=[1, 2], help="numbers of ranks, measured")
    parser.add_argument("--precision", nargs="+", choices=["float64", "float32"], default=["float64", "float32"])
    parser.add_argument("--steps", type=positive, default=7, help="steps of which the median is taken")
    options = parser.parse_args(arguments)
    names = " ".join(f"{name:>10}" for name in GROUPS)
    print(f"cells precision  ranks  s a step speed-up efficiency {names}    memory", flush=True)
    for cells in options.cells:
        for precision in options.precision:
            results = []
            for ranks in options.ranks:
                results.append(measured(cells, ranks, precision, options.steps))
                print(row(results[-1], results[0]), flush=True)


if __name__ == "__main__":
    main()
