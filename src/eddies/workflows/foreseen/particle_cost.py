"""Wall time and memory of an evaluation of a particle model on any number of ranks and threads.

    seconds = sum over parts of (calls * seconds a call + units * seconds a unit / threads) + messages

with what the ranks at hand take for a call and a unit of each part (`particle_probe`), and the units of the busiest
rank (`particle_work`). Loops over pairs, particles, grid points and modes share the threads of a rank; what Python,
numpy and torch do between them, the settling and the messages do not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from eddies.workflows.foreseen.network import NODE_CORES, Network
from eddies.workflows.foreseen.particle_probe import PARTS, THREADED, ParticleSpeed
from eddies.workflows.foreseen.particle_work import (SUMS_OF_EVALUATION, SUMS_OF_ITERATION, SUMS_OF_SETTLING,
                                                     ParticleWork)

MOST_CORES = 4096
# Work of a grid point in the transforms over that of the probe, by cells along a side: more of a plane is copied and
# transformed at once, until planes outgrow the caches. To 168 from tests/benchmarks/particle_step.py with 32^3 to 96^3
# particles, beyond of the slab of one of many ranks.
TRANSFORM_GROWTH = {42: 1.0, 56: 0.85, 112: 0.72, 168: 1.0, 448: 1.0, 896: 1.35}
# Work of a particle in what torch and numpy do, over that of the probe, by particles of a rank: likewise, then arrays
# come as fresh pages. From the same with 24^3 to 96^3 particles.
PARTICLE_GROWTH = {14e3: 1.0, 33e3: 0.85, 110e3: 0.75, 262e3: 0.8, 885e3: 1.2}
# Settling on several ranks over that on one: rows are put in order of ranks and copied as well. From the same, on two.
MIGRATION = 1.7
# Memory of a rank: of a process with torch; of a grid point in single precision and of a particle, ghosts included,
# from steps with 48^3 to 96^3 particles on one and two ranks; of a listed neighbour; of a neighbour whose weights are
# known, in numbers and in indices: what lies between both, ten weights, and what the search and their sums keep, as
# evaluations with 32^3 to 64^3 particles do.
PROCESS_BYTES = 285e6
POINT_BYTES = 160
PARTICLE_BYTES = 800
NEIGHBOR_BYTES = 8
WEIGHT_NUMBERS, WEIGHT_BYTES = 15, 32


@dataclass(frozen=True)
class ParticleCost:
    """What an evaluation needs on so many ranks of so many threads; seconds by part, memory of a rank in bytes."""

    ranks: int
    threads: int
    nodes: int
    memory: float
    parts: dict[str, float]

    @property
    def cores(self) -> int:
        """Cores in use."""
        return self.ranks * self.threads

    @property
    def seconds(self) -> float:
        """Wall time of an evaluation."""
        return sum(self.parts.values())

    @property
    def binds(self) -> str:
        """The part that takes longest."""
        return max(self.parts, key=self.parts.__getitem__)


def particle_cost(work: ParticleWork, speed: ParticleSpeed, ranks: int, threads: int,
                  bandwidth: float) -> ParticleCost:
    """The cost on ranks that send `bandwidth` bytes a second to others of their node."""
    network = Network(ranks, bandwidth, threads)
    calls, units = part_calls(work, speed), part_units(work, speed, ranks)
    parts = {part: calls[part] * speed.rates[part].call
             + units[part] * speed.rates[part].unit / (threads if part in THREADED else 1) for part in PARTS}
    parts["messages"] = (transpose_seconds(work, speed, network) + ghost_plane_seconds(work, speed, network)
                         + halo_seconds(work, speed, network) + settling_seconds(work, network) / work.together
                         + sum_seconds(work, network))
    return ParticleCost(ranks, threads, network.nodes, particle_bytes(work, speed, ranks), parts)


def particle_costs(work: ParticleWork, speed: ParticleSpeed, most: int, bandwidth: float) -> list[ParticleCost]:
    """The fastest splits of 1, 2, 4, ... cores into at most `most` ranks and their threads, up to the fastest."""
    rows = []
    for cores in (2**m for m in range(MOST_CORES.bit_length())):
        splits = [(ranks, cores // ranks) for ranks in (2**m for m in range(most.bit_length()))
                  if ranks <= cores <= ranks * NODE_CORES]
        if splits:
            rows.append(min((particle_cost(work, speed, *split, bandwidth) for split in splits),
                            key=lambda row: (row.seconds, row.threads)))
    return rows[:1 + min(range(len(rows)), key=lambda number: rows[number].seconds)]


# ---- work


def part_calls(work: ParticleWork, speed: ParticleSpeed) -> dict[str, float]:
    """How often each part is asked for in an evaluation: transforms and splines forth and back in each iteration."""
    of_solve = 2 * work.iterations
    return {"pairs": 1, "splines": of_solve + speed.calls["splines"], "settling": 1, "formulas": 1,
            "transforms": of_solve + speed.calls["transforms"], "modes": work.iterations}


def part_units(work: ParticleWork, speed: ParticleSpeed, ranks: int) -> dict[str, float]:
    """What the busiest rank works on in each part: pairs, components at particles or grid points, modes, particles."""
    own = work.own(ranks)
    grown = own * growth(PARTICLE_GROWTH, own)
    return {"pairs": work.pairs(ranks), "splines": components(work, speed, "splines") * own,
            "transforms": (components(work, speed, "transforms") * work.points(ranks)
                           * growth(TRANSFORM_GROWTH, work.cells)),
            "modes": work.iterations * work.modes(ranks), "formulas": grown,
            "settling": grown * (MIGRATION if ranks > 1 else 1.0) * work.settles(ranks)}


def components(work: ParticleWork, speed: ParticleSpeed, part: str) -> float:
    """Components of an evaluation in transforms or splines: a vector forth and back in each iteration."""
    return 6 * work.iterations + speed.components[part]


def growth(measured: Mapping[float, float], size: float) -> float:
    """Work over that of the probe at a size between measured ones."""
    return float(np.interp(math.log(size), np.log(list(measured)), list(measured.values())))


# ---- messages


def transpose_seconds(work: ParticleWork, speed: ParticleSpeed, network: Network) -> float:
    """Seconds in which modes change between columns and planes, for each transform."""
    times = part_calls(work, speed)["transforms"]
    return network.all_to_all(work.transposed_bytes(components(work, speed, "transforms")), times)


def ghost_plane_seconds(work: ParticleWork, speed: ParticleSpeed, network: Network) -> float:
    """Seconds in which splines get or give their planes on the neighbours, up and down."""
    size = work.ghost_plane_bytes(components(work, speed, "splines"))
    return network.to_neighbors(size / 2, 2 * part_calls(work, speed)["splines"])


def halo_seconds(work: ParticleWork, speed: ParticleSpeed, network: Network) -> float:
    """Seconds in which copies of particles are counted and sent, up and down."""
    if not speed.ghost_columns:
        return 0.0
    size = work.ghosts(network.ranks) * sum(speed.ghost_columns)
    return network.to_neighbors(size / 2, 2 * (1 + len(speed.ghost_columns))) / work.together


def settling_seconds(work: ParticleWork, network: Network) -> float:
    """Seconds in which particles change rank, to the next one in nearly all cases: each column, and how many there are,
    from each rank to every other; with sums that tell whether any is lost."""
    if not work.settles(network.ranks):
        return 0.0
    return (network.all_to_all(0.0, 1 + work.settled_columns())
            + network.to_neighbors(work.movers() * work.settled_bytes() / 2, 0) + network.sum_over_ranks(
                SUMS_OF_SETTLING))


def sum_seconds(work: ParticleWork, network: Network) -> float:
    """Seconds of the sums over all ranks in the solve and around it."""
    return network.sum_over_ranks(SUMS_OF_ITERATION * work.iterations + SUMS_OF_EVALUATION)


# ---- memory


def particle_bytes(work: ParticleWork, speed: ParticleSpeed, ranks: int) -> float:
    """Memory of a rank in a rollout: pairs that the compiled library sums are kept nowhere."""
    seen = work.own(ranks) + work.ghosts(ranks)
    points = work.cells**2 * work.planes(ranks) if work.wavenumber else 0
    size = PROCESS_BYTES + PARTICLE_BYTES * seen + POINT_BYTES * work.real / 4 * points
    return size + (list_bytes(work, speed, ranks) + speed.block_bytes if speed.listed and work.neighbors else 0.0)


def list_bytes(work: ParticleWork, speed: ParticleSpeed, ranks: int) -> float:
    """Memory of the list of neighbours, those within the skin included, and of what they tell."""
    listed = work.neighbors * (1 + work.skin / work.radius) ** 3
    told = (WEIGHT_NUMBERS * work.real + WEIGHT_BYTES) * work.neighbors if speed.kriging else 0.0
    return work.own(ranks) * (NEIGHBOR_BYTES * listed + told)
