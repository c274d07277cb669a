"""Messages and bytes that a rank sends in an evaluation of a particle model, by numbers of ranks.

    PYTHONPATH=. .venv/bin/python tests/benchmarks/messages.py docs/performance.json [--models NAME ...] [--ranks R ...]

Open MPI counts what each rank sends to each other one (its component pml_monitoring). Collective operations count as
the messages of which they consist. The difference between a job of four and one of two steps leaves out the start.
Writes a row `messages` for each model and number of ranks into the file, the largest count over ranks and the mean, and
prints them as a table.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import torch
from mpi4py import MPI
from particle_step import Run

from eddies.scene.terms import PRESETS
from mpi_tools.launch import mpi_environment, mpirun_command

STEPS = 2
MODELS = ("paper", "local", "resolved", "resolved + pairs")


def advance(side: int, model: str, steps: int) -> None:
    """Take steps, and print the number of evaluations."""
    with torch.no_grad():
        run = Run(MPI.COMM_WORLD, side, model, "float32")
        before = run.dynamics.evaluations
        for _ in range(steps):
            run.advance()
    if MPI.COMM_WORLD.rank == 0:
        print(run.dynamics.evaluations - before)


def counted(ranks: int, side: int, model: str, steps: int) -> tuple[int, dict[int, Counter]]:
    """Evaluations of a job, and what each rank has sent in it."""
    with tempfile.TemporaryDirectory() as folder:
        monitored = {"OMPI_MCA_pml_monitoring_enable": "2", "OMPI_MCA_pml_monitoring_enable_output": "3",
                     "OMPI_MCA_pml_monitoring_filename": f"{folder}/sent"}
        done = subprocess.run(mpirun_command(ranks, [sys.executable, "-m", "mpi4py", __file__, "", "--side", str(side),
                                                     "--models", model, "--steps", str(steps)]),
                              env=mpi_environment(ranks) | monitored | {"PYTHONPATH": os.pathsep.join(sys.path)},
                              check=True, capture_output=True, text=True)
        sent = {rank: Counter() for rank in range(ranks)}
        for file in Path(folder).iterdir():
            for rank, size, messages in re.findall(r"^[EI]\t(\d+)\t\d+\t(\d+) bytes\t(\d+) msgs", file.read_text(),
                                                   re.MULTILINE):
                sent[int(rank)] += Counter(bytes=int(size), messages=int(messages))
    return int(done.stdout), sent


def table(rows: list[dict]) -> str:
    """Messages and kB that a rank sends in an evaluation, on average."""
    numbers = sorted({row["ranks"] for row in rows})
    lines = ["| model |" + "|".join(f" {ranks} ranks " for ranks in numbers) + "|", "|---" * (1 + len(numbers)) + "|"]
    for model in dict.fromkeys(row["model"] for row in rows):
        cells = {row["ranks"]: f" {row['mean_messages']}; {row['mean_bytes'] / 1000:.0f} kB "
                 for row in rows if row["model"] == model}
        lines.append(f"| `{model}` |" + "|".join(cells.get(ranks, " ") for ranks in numbers) + "|")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("results", type=Path, help="the file of results")
    parser.add_argument("--side", type=int, default=32, help="cube root of the number of particles")
    parser.add_argument("--models", nargs="+", choices=PRESETS, default=MODELS)
    parser.add_argument("--ranks", nargs="+", type=int, default=[2, 3, 4, 6, 8])
    parser.add_argument("--steps", type=int, help="take steps as a rank of a job that is counted")
    options = parser.parse_args()
    if options.steps is not None:
        return advance(options.side, *options.models, options.steps)
    found = json.loads(options.results.read_text())
    rows = {(row["model"], row["ranks"]): row for row in found.get("messages", [])}
    for model in options.models:
        for ranks in options.ranks:
            (few, before), (many, after) = (counted(ranks, options.side, model, steps) for steps in (STEPS, 2 * STEPS))
            sent = {name: [(after[rank][name] - before[rank][name]) / (many - few) for rank in range(ranks)]
                    for name in ("messages", "bytes")}
            rows[model, ranks] = {"particles": options.side, "model": model, "ranks": ranks} | {
                f"{kind}_{name}": round(value) for name, values in sent.items()
                for kind, value in (("most", max(values)), ("mean", sum(values) / ranks))}
            found["messages"] = [*rows.values()]
            options.results.write_text(json.dumps(found, indent=1) + "\n")
    print(table(found["messages"]))


if __name__ == "__main__":
    main()
