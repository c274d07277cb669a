"""Cost of an evaluation of a particle model: measurements and bounds, projection to up to 4096 cores, and figure.

    OMP_NUM_THREADS=1 .venv/bin/python tests/benchmarks/performance.py measure docs/performance.json  # 10 to 30 min
    PYTHONPATH=. .venv/bin/python tests/benchmarks/messages.py docs/performance.json  # 15 min on two cores
    .venv/bin/python tests/benchmarks/performance.py project docs/performance.json
    .venv/bin/python tests/benchmarks/performance.py draw docs/performance.json docs/performance.png

Runs other programs of this folder: `particle_step.py` on one rank, on one rank with two threads and on two ranks, and
`step.py` for a grid of 1.5 cells per particle and direction, which the same filter would need. The bounds of pairs and
splines are their arithmetic at the speed of a matrix product, that of transforms is FFTW alone. `draw` also prints the
table of seconds per evaluation. It leaves out models that the file does not hold.

`project` measures nothing: seconds of a call and of a unit of work of each part follow from the measured evaluations of
16^3 and 64^3 particles on one core; messages and bytes from those counted on up to eight ranks, on an assumed network.
It writes the rows `projected` into the file, and prints them as a table, and the deviation of the projection from the
measurements.
"""

import argparse
import json
import math
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpi4py import MPI
from step import best, transform_bounds

from eddies.parallel.slab import SlabDecomposition
from eddies.particles.flow_units import planes_for, resolved_shells
from eddies.report import figures
from eddies.report.figures import BLUE, GRID, MODEL, SECOND, THIRD, letter, panels, styled
from eddies.scene.scene import BOX_LENGTH, Scene, load_scene
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.workflows.estimates import estimate, most_ranks
from eddies.workflows.learned.source import ModelDefinition
from eddies.workflows.variant_rows import processor

HERE = Path(__file__).parent
sys.path.append(str(HERE.parents[1] / "docs"))

from pictures import save  # noqa: E402

LAYOUTS, SIDES = ((1, 1), (1, 2), (2, 1)), (16, 24, 32, 48, 64, 96)
MODELS = "resolved", "resolved + pairs", "paper"  # the second one is projected to more cores
ALL_LAYOUTS = 64             # particles per side; more run on two ranks only, without `paper`, the slowest
CELLS_A_PARTICLE = 1.5
# Operations of the network 16-16 per pair: multiplications with additions; a tanh counts as eleven.
PAIR_FLOPS = 2 * (3 * 16 + 16 * 16 + 16 * 2 + 32 * 11)
SPLINE_FLOPS = 2 * 4**3      # per component and particle
# Components of transforms and splines in an evaluation, in addition to six in each iteration.
TRANSFORMED, INTERPOLATED = 31, 13
# Seconds for 64^3 particles: the notebooks published with the method on two cores, and the paper on one A100.
NOTEBOOKS, PAPER = 46.0, 0.5

# ---- projection
PROJECTED, TABLE_CORES, MOST_CORES = (64, 128, 256, 512), (16, 64, 256, 1024, 4096), 4096
# The cluster: cores of a node; bytes a second of a rank within its node, and of a node to all others; seconds of a
# message.
NODE_CORES, RANK_BANDWIDTH, NODE_BANDWIDTH, LATENCY = 64, 2e9, 10e9, 2e-6
THREADED = "pairs", "splines", "transforms", "modes"  # whose loops the threads of a rank share
COMPONENTS = {"transforms": TRANSFORMED, "splines": INTERPOLATED}
ITERATIONS_COUNTED = 2.5     # of the solve with 32^3 particles, whose messages are counted
# Work of a grid point of a transform over that of 112^3, by cells along a side; beyond 168 measured for the slab of one
# of many ranks.
GROWTH = {112: 1.0, 168: 1.4, 448: 1.4, 896: 1.9}
MIGRATION = 1.7              # settling on several ranks over that on one


def measure() -> dict:
    """All measurements and bounds."""
    found: dict = {"processor": processor(), "cores": os.cpu_count(), "steps": [], "grid": []}
    for side in SIDES:
        for model in MODELS if side <= ALL_LAYOUTS else MODELS[:2]:
            for ranks, threads in LAYOUTS if side <= ALL_LAYOUTS else LAYOUTS[-1:]:
                found["steps"].append(of_job(ranks, threads, "particle_step.py", side, "--model", model,
                                             "--threads", threads))
        found["grid"].append(of_job(2, 1, "step.py", round(CELLS_A_PARTICLE * side), "--precision", "float32"))
    taken = next(row["iterations"] for row in found["steps"] if (row["particles"], row["model"]) == (64, MODELS[1]))
    return found | {"bounds": bounds(taken)}


def of_job(ranks: int, threads: int, program: str, *arguments: object) -> dict:
    """The JSON in the last line of a program on some ranks."""
    command = [sys.executable, HERE.parents[1] / "mpi_tools/launch.py", "-n", ranks, "--", sys.executable, "-m",
               "mpi4py", HERE / program, *arguments]
    done = subprocess.run(list(map(str, command)), env={**os.environ, "OMP_NUM_THREADS": str(threads)}, check=True,
                          capture_output=True, text=True)
    line = done.stdout.splitlines()[-1]
    print(line, flush=True)
    return json.loads(line)


def scene_of(side: int, model: str) -> Scene:
    """`hit` without variants, with other numbers of particles and cells."""
    return load_scene("hit", [f"tracers.particles_per_side={side}", f"flow.cells={4 * side}",
                              f"tracers.field_cells={round(CELLS_A_PARTICLE * side)}",
                              f"flow.viscosity={0.0072 * (32 / side) ** (4 / 3)}", f'model.preset="{model}"'],
                      ["variant"])


def shells_of(scene: Scene) -> int:
    """Highest wavenumber of the resolved velocity."""
    tracers = scene.tracers
    return resolved_shells(tracers.spacing, tracers.filter_width, estimate(scene).scales["kolmogorov_length"],
                           BOX_LENGTH, planes_for(tracers.particles))


def bounds(iterations: float) -> dict[str, float]:
    """Lower bounds of the seconds of parts of an evaluation with 64^3 particles on one core."""
    a, b = np.ones((2, 1024, 1024), np.float32)
    flops = 2 * 1024**3 / best(lambda: a @ b)
    scene = scene_of(64, MODELS[1])
    particles = scene.tracers.particles
    slab = SlabDecomposition(MPI.COMM_SELF, 2 * math.pi, planes_for(particles))
    grid = SpectralGrid(slab, "float32", shells_of(scene))
    return {"flops": flops,
            "pairs": particles * ModelDefinition.of(scene).neighbors / 2 * PAIR_FLOPS / flops,
            "transforms": sum(transform_bounds(grid, 1, 1, 1).values()) * (6 * iterations + TRANSFORMED) / 2,
            "splines": (6 * iterations + INTERPOLATED) * particles * SPLINE_FLOPS / flops}


@dataclass(frozen=True)
class Counted:
    """What `messages.py` has counted for a model: messages `first` + `each` (ranks - 1), and bytes over `Job.sent`."""

    first: float
    each: float
    bytes: float


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
        planes = planes_for(self.scene.tracers.particles)
        return math.ceil(planes / self.ranks) / planes

    def components(self, part: str) -> float:
        """Number of components that an evaluation transforms or interpolates."""
        return 6 * self.iterations + COMPONENTS[part]

    def units(self) -> dict[str, float]:
        """Work of the busiest rank: pairs, components at particles and grid points, modes, particles."""
        tracers, paired = self.scene.tracers, "pairs" in self.scene.model.reads
        planes, definition = planes_for(tracers.particles), ModelDefinition.of(self.scene)
        own, points = tracers.particles * self.share, planes**3 * self.share
        # Pairs across the faces of a slab are evaluated on both sides.
        doubled = (self.ranks > 1) * 3 * definition.radius / (8 * self.share * BOX_LENGTH)
        return {"pairs": own * definition.neighbors / 2 * (1 + doubled) * paired,
                "splines": self.components("splines") * own,
                "transforms": self.components("transforms") * points * growth(planes),
                "modes": self.iterations * shells_of(self.scene) ** 3 * self.share, "formulas": own,
                "settling": own * (MIGRATION if self.ranks > 1 else 1.0)}

    def sent(self) -> tuple[float, float]:
        """Bytes that a rank sends: in transposes between all ranks, and to its neighbours (ghost planes, ghosts)."""
        particles, k = self.scene.tracers.particles, shells_of(self.scene)
        transposed = self.components("transforms") * planes_for(particles) * (2 * k + 1) * (k + 1) * 8 / self.ranks
        planes = self.components("splines") * 5 * planes_for(particles) ** 2 * 4
        ghosts = 2 * particles * ModelDefinition.of(self.scene).radius / BOX_LENGTH * 80
        return (transposed * (self.ranks - 1) / self.ranks,
                planes + ghosts * ("pairs" in self.scene.model.reads))

    def messages(self, counted: Counted) -> float:
        """Seconds of the messages on the assumed cluster."""
        if self.ranks == 1:
            return 0.0
        on_node = min(self.ranks, max(NODE_CORES // self.threads, 1))
        between_all, beside = (counted.bytes * size for size in self.sent())
        far = (self.ranks - on_node) / (self.ranks - 1)
        return (between_all * ((1 - far) / RANK_BANDWIDTH + far * on_node / NODE_BANDWIDTH) + beside / RANK_BANDWIDTH
                + LATENCY * (counted.first + counted.each * (self.ranks - 1)))


def counted_of(found: dict, model: str) -> Counted:
    """The counts of a model, as a linear function of the ranks."""
    rows = [row for row in found["messages"] if row["model"] == model]
    each, first = np.polyfit([row["ranks"] - 1 for row in rows], [row["mean_messages"] for row in rows], 1)
    sent = [sum(Job(scene_of(row["particles"], model), ITERATIONS_COUNTED, row["ranks"]).sent()) for row in rows]
    share = np.mean([row["mean_bytes"] / size for row, size in zip(rows, sent)])
    return Counted(float(first), float(each), float(share))


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


def evaluation(job: Job, of_parts: dict[str, tuple[float, float]], counted: Counted) -> dict[str, float]:
    """Seconds of each part of an evaluation."""
    units = job.units()
    return {**{part: call + unit * units[part] / (job.threads if part in THREADED else 1)
               for part, (call, unit) in of_parts.items()}, "messages": job.messages(counted)}


def projected(found: dict) -> list[dict]:
    """The fastest split of 1, 2, 4, ... cores into ranks and threads, up to the fastest number of cores."""
    of_parts, counted, rows = rates(found, MODELS[1]), counted_of(found, MODELS[1]), []
    iterations = next(row["iterations"] for row in found["steps"] if row["particles"] == 64)
    for side in PROJECTED:
        scene, own = scene_of(side, MODELS[1]), []
        powers = [2**m for m in range(MOST_CORES.bit_length())]
        for cores in powers:
            splits = [Job(scene, iterations, ranks, cores // ranks) for ranks in powers
                      if ranks <= cores <= ranks * NODE_CORES and ranks <= min(most_ranks(scene).values())]
            timed = [(sum((parts := evaluation(job, of_parts, counted)).values()), job.threads, job, parts)
                     for job in splits]
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
        total = sum(evaluation(job, rates(found, row["model"]), counted_of(found, row["model"])).values())
        largest[side] = max(largest.get(side, 0.0), abs(total / row["seconds_per_evaluation"] - 1))
    return largest


def table_of_cores(found: dict) -> str:
    """The projected seconds as a table: a row for each number of cores."""
    lines = ["| cores |" + "|".join(f" {side}³ " for side in PROJECTED) + "|", "|---" * (1 + len(PROJECTED)) + "|"]
    for cores in TABLE_CORES:
        cells = [next((f" {row['ranks']} x {row['threads']}: {row['seconds']:.2g} s, {row['binds']} "
                       for row in found["projected"] if (row["particles"], row["cores"]) == (side, cores)), " ")
                 for side in PROJECTED]
        lines.append(f"| {cores} |" + "|".join(cells) + "|")
    return "\n".join(lines)


@styled
def draw(found: dict) -> Figure:
    """Figure: seconds over particles, parts with bounds, and seconds over cores."""
    figure, (axes,) = panels(1, 3, (3.4, 3.4))
    figure.set_layout_engine("constrained")  # for labels and legends that are wide
    over_particles(axes[0], found)
    parts(axes[1], found)
    over_cores(axes[2], found)
    letter(axes)
    return figure


def measured_models(found: dict) -> list[str]:
    """The models of which a file holds measurements."""
    return [model for model in MODELS if any(row["model"] == model for row in found["steps"])]


def table(found: dict) -> str:
    """Seconds per evaluation of each model as a table: a row for each number of particles, a column for each layout."""
    models = measured_models(found)
    lines = [["particles", *(f"`{model}`, {ranks} x {threads}" for model in models for ranks, threads in LAYOUTS)]]
    lines.append(["---"] * len(lines[0]))
    for side in dict.fromkeys(row["particles"] for row in found["steps"]):
        known = {(row["model"], row["ranks"], row["threads"]): f"{row['seconds_per_evaluation']:.2g}"
                 for row in found["steps"] if row["particles"] == side}
        lines.append([f"{side}³", *(known.get((model, *layout), "") for model in models for layout in LAYOUTS)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def seconds_of(found: dict, model: str, ranks: int, threads: int) -> tuple[np.ndarray, np.ndarray]:
    """Particles per side and seconds per evaluation of a layout."""
    rows = [row for row in found["steps"] if (row["model"], row["ranks"], row["threads"]) == (model, ranks, threads)]
    return np.array([row["particles"] for row in rows]), np.array([row["seconds_per_evaluation"] for row in rows])


def over_particles(axis: Axes, found: dict) -> None:
    """Seconds per evaluation on two ranks, with slopes."""
    looks = figures.looks({model: [model] for model in measured_models(found)}, {})
    for model, (colour, marker) in looks.items():
        side, seconds = seconds_of(found, model, 2, 1)
        slope = np.polyfit(np.log(side[2:] ** 3), np.log(seconds[2:]), 1)[0]
        axis.loglog(side**3, seconds, marker=marker, color=colour, label=f"{model}, slope {slope:.2f}")
    cells = np.array([row["cells"] for row in found["grid"]])
    axis.loglog((cells / CELLS_A_PARTICLE) ** 3, [row["seconds_per_step"] / 4 for row in found["grid"]],
                marker=GRID, color=BLUE, label="grid of 1.5 cells a particle")
    axis.loglog(64**3, NOTEBOOKS, "*", color="black", markersize=9, linestyle="none", label="published notebooks")
    axis.loglog(64**3, PAPER, "P", color=MODEL, linestyle="none", label="the paper, one A100")
    axis.set_xticks([side**3 for side in SIDES], [f"{side}³" for side in SIDES])
    axis.minorticks_off()
    axis.set(title="two cores", xlabel="particles", ylabel="seconds an evaluation")
    axis.set_ylim(top=1e6)  # the legend stands above the marks
    axis.legend(loc="upper left", fontsize=8)


def parts(axis: Axes, found: dict) -> None:
    """Parts of an evaluation with 64^3 particles by layout, and their lower bounds."""
    names = ("pairs", "transforms", "splines", "settle", "the rest")
    for number, (ranks, threads) in enumerate(LAYOUTS):
        row = next(row for row in found["steps"] if (row["particles"], row["model"], row["ranks"], row["threads"])
                   == (64, MODELS[1], ranks, threads))
        given = dict(row["parts"])
        values = [given.pop(name) for name in names[:-1]]
        label = f"{ranks} rank{'s' * (ranks > 1)}" + f" x {threads} threads" * (threads > 1)
        axis.bar(np.arange(5) + 0.27 * (number - 1), [*values, sum(given.values())], 0.25, label=label,
                 color=(BLUE, SECOND, MODEL)[number])
    for place, name in enumerate(names[:3]):
        for shift, cores in ((-0.27, 1), (0.135, 2)):
            width = 0.25 if cores == 1 else 0.52
            bound = found["bounds"][name] / cores
            axis.hlines(bound, place + shift - width / 2, place + shift + width / 2, color="black", linewidth=2,
                        label="least" if place == 0 and cores == 1 else None)
    axis.set_xticks(range(5), names, rotation=30, ha="right", rotation_mode="anchor")
    axis.set(title="64³ particles, with pairs", ylabel="seconds an evaluation")
    axis.legend()


def over_cores(axis: Axes, found: dict) -> None:
    """Projection to more cores, and measurements on one and two."""
    sides = dict.fromkeys(row["particles"] for row in found["projected"])
    for side, colour in zip(sides, (BLUE, MODEL, SECOND, THIRD)):
        rows = [row for row in found["projected"] if row["particles"] == side]
        axis.loglog([row["cores"] for row in rows], [row["seconds"] for row in rows], "--", color=colour,
                    label=f"{side}³")
        threaded = [row for row in rows if row["threads"] > 1]
        axis.loglog([row["cores"] for row in threaded], [row["seconds"] for row in threaded], ".", color=colour)
    for ranks, threads in LAYOUTS:
        side, seconds = seconds_of(found, MODELS[1], ranks, threads)
        axis.loglog(ranks * threads, seconds[side == 64], "s" if threads > 1 else "o", color=BLUE)
    axis.set(title="projected, with pairs", xlabel="cores", ylabel="seconds an evaluation")
    axis.legend(title="particles", loc="upper right")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("action", choices=("measure", "project", "draw"))
    parser.add_argument("results", type=Path)
    parser.add_argument("figure", type=Path, nargs="?")
    options = parser.parse_args()
    if options.action == "measure":
        options.results.write_text(json.dumps(measure(), indent=1) + "\n")
        return
    found = json.loads(options.results.read_text())
    if options.action == "project":
        found["projected"] = projected(found)
        options.results.write_text(json.dumps(found, indent=1) + "\n")
        print(table_of_cores(found))
        print("deviation:", ", ".join(f"{side}³ {deviation:.0%}" for side, deviation in deviations(found).items()))
    else:
        print(table(found))
        save(options.figure, draw(found))


if __name__ == "__main__":
    main()
