"""Projected cost of an evaluation of the particles on up to 4096 cores.

    .venv/bin/python tests/benchmarks/projection.py docs/performance.json

This measures nothing: seconds of a call and of a unit of work of each part follow from the measured evaluations of 16^3
and 64^3 particles on one core; messages are those of an assumed network. It writes the rows `projected` into the file,
and prints the table of docs/performance.md and the deviation of the projection from the measurements.
"""

import argparse
import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from performance import INTERPOLATED, MODELS, TRANSFORMED, scene_of, shells_of

from eddies.scene.scene import BOX_LENGTH, Scene
from eddies.workflows.estimates import most_ranks

SIDES, TABLE_CORES, MOST_CORES = (64, 128, 256, 512), (16, 64, 256, 1024, 4096), 4096
# The cluster: cores of a node; bytes a second of a rank within its node, and of a node to all others; seconds of a
# message.
NODE_CORES, RANK_BANDWIDTH, NODE_BANDWIDTH, LATENCY = 64, 2e9, 10e9, 2e-6
THREADED = "pairs", "splines", "transforms", "modes"  # whose loops the threads of a rank share
COMPONENTS = {"transforms": TRANSFORMED, "splines": INTERPOLATED}
# Transforms of an evaluation outside the iterations, which have two each; sums over ranks outside the iterations, and
# in each; columns that a migration sends.
CALLS, SUMS, COLUMNS = 8, (11, 2), 8
# Work of a grid point of a transform over that of 112^3, by cells along a side; beyond 168 measured for the slab of one
# of many ranks.
GROWTH = {112: 1.0, 168: 1.4, 448: 1.4, 896: 1.9}
MIGRATION = 1.7              # settling on several ranks over that on one


@dataclass(frozen=True)
class Job:
    """An evaluation of a scene's model with a number of iterations of the solve, on ranks of some threads."""

    scene: Scene
    iterations: float
    ranks: int = 1
    threads: int = 1

    @property
    def share(self) -> float:
        """Share of the planes in the thickest slab."""
        planes = self.scene.tracers.planes
        return math.ceil(planes / self.ranks) / planes

    def components(self, part: str) -> float:
        """Number of components that an evaluation transforms or interpolates."""
        return 6 * self.iterations + COMPONENTS[part]

    def units(self) -> dict[str, float]:
        """Work of the busiest rank: pairs, components at particles and grid points, modes, particles."""
        tracers, paired = self.scene.tracers, "pairs" in self.scene.model.reads
        own, points = tracers.particles * self.share, tracers.planes**3 * self.share
        # Pairs across the faces of a slab are evaluated on both sides.
        doubled = (self.ranks > 1) * 3 * self.scene.interaction_radius / (8 * self.share * BOX_LENGTH)
        return {"pairs": own * self.scene.neighbors / 2 * (1 + doubled) * paired,
                "splines": self.components("splines") * own,
                "transforms": self.components("transforms") * points * growth(tracers.planes),
                "modes": self.iterations * shells_of(self.scene) ** 3 * self.share, "formulas": own,
                "settling": own * (MIGRATION if self.ranks > 1 else 1.0)}

    def messages(self) -> float:
        """Seconds of the messages: transposes between all ranks, ghosts and ghost planes between neighbours, particles
        that migrate, and sums along a tree."""
        if self.ranks == 1:
            return 0.0
        tracers, k = self.scene.tracers, shells_of(self.scene)
        on_node = min(self.ranks, max(NODE_CORES // self.threads, 1))
        own = self.components("transforms") * tracers.planes * (2 * k + 1) * (k + 1) * 8 / self.ranks
        calls = 2 * self.iterations + CALLS
        sent = own * ((on_node - 1) / self.ranks / RANK_BANDWIDTH
                      + (self.ranks - on_node) / self.ranks * on_node / NODE_BANDWIDTH)
        planes = self.components("splines") * 5 * tracers.planes**2 * 4
        ghosts = 2 * tracers.particles * self.scene.interaction_radius / BOX_LENGTH * 80
        beside = (planes + ghosts * ("pairs" in self.scene.model.reads)) / RANK_BANDWIDTH
        sums = 2 * math.ceil(math.log2(self.ranks)) * (SUMS[0] + SUMS[1] * self.iterations)
        return sent + beside + LATENCY * ((calls + COLUMNS) * (self.ranks - 1) + 2 * calls + sums)


def growth(cells: int) -> float:
    """Work of a grid point of a transform over that of 112^3."""
    return float(np.interp(math.log(cells), np.log(list(GROWTH)), list(GROWTH.values())))


def parts_of(row: dict) -> dict[str, float]:
    """Measured seconds of the parts of an evaluation, by the kind of their work."""
    parts = row["parts"]
    return {"pairs": parts["pairs"], "splines": parts["splines"], "transforms": parts["transforms"],
            "modes": parts["vectors"] + parts["solve, the rest"], "settling": parts["settle"],
            "formulas": parts["closure, the rest"] + parts["the rest"]}


def rates(found: dict, model: str) -> dict[str, tuple[float, float]]:
    """Seconds of a call and of a unit of work of each part, from the rows of 16^3 and 64^3 particles on one core."""
    few, many = (next(row for row in found["steps"] if (row["particles"], row["model"], row["ranks"], row["threads"])
                      == (side, model, 1, 1)) for side in (16, 64))
    sizes = [Job(scene_of(row["particles"], model), row["iterations"]).units() for row in (few, many)]
    result = {}
    for part, seconds_few in parts_of(few).items():
        span = sizes[1][part] - sizes[0][part]
        unit = (parts_of(many)[part] - seconds_few) / span if span else 0.0
        result[part] = max(seconds_few - unit * sizes[0][part], 0.0), unit
    return result


def evaluation(job: Job, of_parts: dict[str, tuple[float, float]]) -> dict[str, float]:
    """Seconds of each part of an evaluation."""
    units = job.units()
    return {**{part: call + unit * units[part] / (job.threads if part in THREADED else 1)
               for part, (call, unit) in of_parts.items()}, "messages": job.messages()}


def projected(found: dict) -> list[dict]:
    """The fastest split of 1, 2, 4, ... cores into ranks and threads, up to the fastest number of cores."""
    of_parts, rows = rates(found, MODELS[1]), []
    iterations = next(row["iterations"] for row in found["steps"] if row["particles"] == 64)
    for side in SIDES:
        scene, own = scene_of(side, MODELS[1]), []
        powers = [2**m for m in range(MOST_CORES.bit_length())]
        for cores in powers:
            splits = [Job(scene, iterations, ranks, cores // ranks) for ranks in powers
                      if ranks <= cores <= ranks * NODE_CORES and ranks <= min(most_ranks(scene).values())]
            timed = [(sum((parts := evaluation(job, of_parts)).values()), job.threads, job, parts) for job in splits]
            total, threads, job, parts = min(timed, key=lambda row: row[:2], default=(0.0, 0, None, {}))
            if job is not None:
                own.append({"particles": side, "cores": cores, "ranks": job.ranks, "threads": threads,
                            "seconds": total, "binds": max(parts, key=parts.__getitem__)})
        rows += own[:1 + min(range(len(own)), key=lambda number: own[number]["seconds"])]
    return rows


def deviations(found: dict) -> dict[int, float]:
    """Largest relative deviation of the projection from the measured evaluations, by particles per side."""
    largest: dict[int, float] = {}
    for row in found["steps"]:
        side = row["particles"]
        job = Job(scene_of(side, row["model"]), row["iterations"], row["ranks"], row["threads"])
        total = sum(evaluation(job, rates(found, row["model"])).values())
        largest[side] = max(largest.get(side, 0.0), abs(total / row["seconds_per_evaluation"] - 1))
    return largest


def table(found: dict) -> str:
    """The table of docs/performance.md: seconds by cores."""
    lines = ["| cores |" + "|".join(f" {side}³ " for side in SIDES) + "|", "|---" * (1 + len(SIDES)) + "|"]
    for cores in TABLE_CORES:
        cells = [next((f" {row['ranks']} x {row['threads']}: {row['seconds']:.2g} s, {row['binds']} "
                       for row in found["projected"] if (row["particles"], row["cores"]) == (side, cores)), " ")
                 for side in SIDES]
        lines.append(f"| {cores} |" + "|".join(cells) + "|")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path, help="the file of results")
    file = parser.parse_args().file
    found = json.loads(file.read_text())
    found["projected"] = projected(found)
    file.write_text(json.dumps(found, indent=1) + "\n")
    print(table(found))
    print("deviation:", ", ".join(f"{side}³ {deviation:.0%}" for side, deviation in deviations(found).items()))


if __name__ == "__main__":
    main()
