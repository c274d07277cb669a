"""Cost of an evaluation of a particle model over particles, ranks and threads: measurements, bounds and figure.

    OMP_NUM_THREADS=1 .venv/bin/python tests/benchmarks/performance.py measure docs/performance.json  # 10 min
    .venv/bin/python tests/benchmarks/projection.py docs/performance.json  # projection to more cores
    .venv/bin/python tests/benchmarks/performance.py draw docs/performance.json docs/performance.png

Runs other programs of this folder: `particle_step.py` on one rank, on one rank with two threads and on two ranks, and
`step.py` for a grid of 1.5 cells per particle and direction, which the same filter would need. The bounds of pairs and
splines are their arithmetic at the speed of a matrix product, that of transforms is FFTW alone. `draw` also prints the
table of seconds per evaluation. It leaves out models that the file does not hold.
"""

import argparse
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from mpi4py import MPI
from step import best, transform_bounds

from eddies.parallel.slab import SlabDecomposition
from eddies.particles.flow_units import resolved_shells
from eddies.report.figures import BLUE, FOURTH, MODEL, SECOND, THIRD, letter, panels, png, styled
from eddies.scene.scene import BOX_LENGTH, Scene, load_scene
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.workflows.estimates import estimate
from eddies.workflows.variant_rows import processor

HERE = Path(__file__).parent
LAYOUTS, SIDES = ((1, 1), (1, 2), (2, 1)), (16, 24, 32, 48, 64, 96)
MODELS = "resolved", "resolved + pairs", "paper"  # the second one is projected to more cores
ALL_LAYOUTS = 64             # particles per side; larger ones run on two ranks only
CELLS_A_PARTICLE = 1.5
# Operations of the network 16-16 per pair: multiplications with additions; a tanh counts as eleven.
PAIR_FLOPS = 2 * (3 * 16 + 16 * 16 + 16 * 2 + 32 * 11)
SPLINE_FLOPS = 2 * 4**3      # per component and particle
# Components of transforms and splines in an evaluation, in addition to six in each iteration.
TRANSFORMED, INTERPOLATED = 31, 13
# Seconds for 64^3 particles: the notebooks published with the method on two cores, and the paper on one A100.
NOTEBOOKS, PAPER = 46.0, 0.5


def measure() -> dict:
    """All measurements and bounds."""
    found: dict = {"processor": processor(), "cores": os.cpu_count(), "steps": [], "grid": []}
    for side in SIDES:
        for model in MODELS:
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
                           BOX_LENGTH, tracers.planes)


def bounds(iterations: float) -> dict[str, float]:
    """Lower bounds of the seconds of parts of an evaluation with 64^3 particles on one core."""
    a, b = np.ones((2, 1024, 1024), np.float32)
    flops = 2 * 1024**3 / best(lambda: a @ b)
    scene = scene_of(64, MODELS[1])
    particles, slab = scene.tracers.particles, SlabDecomposition(MPI.COMM_SELF, 2 * math.pi, scene.tracers.planes)
    grid = SpectralGrid(slab, "float32", shells_of(scene))
    return {"flops": flops,
            "pairs": particles * scene.neighbors / 2 * PAIR_FLOPS / flops,
            "transforms": sum(transform_bounds(grid, 1, 1, 1).values()) * (6 * iterations + TRANSFORMED) / 2,
            "splines": (6 * iterations + INTERPOLATED) * particles * SPLINE_FLOPS / flops}


@styled
def draw(found: dict) -> bytes:
    """Figure: seconds over particles, parts with bounds, and seconds over cores."""
    figure, (axes,) = panels(1, 3, (4.2, 3.6))
    figure.set_layout_engine("constrained")  # for labels and legends that are wide
    over_particles(axes[0], found)
    parts(axes[1], found)
    over_cores(axes[2], found)
    letter(axes)
    return png(figure)


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
    for model, colour in zip(measured_models(found), (BLUE, MODEL, FOURTH)):
        side, seconds = seconds_of(found, model, 2, 1)
        slope = np.polyfit(np.log(side[2:] ** 3), np.log(seconds[2:]), 1)[0]
        axis.loglog(side**3, seconds, "o-", color=colour, label=f"{model}, slope {slope:.2f}")
    cells = np.array([row["cells"] for row in found["grid"]])
    axis.loglog((cells / CELLS_A_PARTICLE) ** 3, [row["seconds_per_step"] / 4 for row in found["grid"]], "s-",
                color=SECOND, label="grid of 1.5 cells a particle")
    axis.loglog(64**3, NOTEBOOKS, "*", color="black", markersize=10)
    axis.annotate("published notebooks", (64**3, NOTEBOOKS), xytext=(-6, -3), textcoords="offset points", ha="right")
    axis.loglog(64**3, PAPER, "D", color=THIRD, label="the paper, one A100")
    axis.set_xticks([side**3 for side in SIDES], [f"{side}³" for side in SIDES])
    axis.minorticks_off()
    axis.set(title="two cores", xlabel="particles", ylabel="seconds an evaluation")
    axis.legend(loc="upper left", bbox_to_anchor=(0, 0.93))


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
    axis.set_xticks(range(5), names)
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
    parser.add_argument("action", choices=("measure", "draw"))
    parser.add_argument("results", type=Path)
    parser.add_argument("figure", type=Path, nargs="?")
    options = parser.parse_args()
    if options.action == "measure":
        options.results.write_text(json.dumps(measure(), indent=1) + "\n")
    else:
        found = json.loads(options.results.read_text())
        print(table(found))
        options.figure.write_bytes(draw(found))


if __name__ == "__main__":
    main()
