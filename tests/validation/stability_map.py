"""The map of stability of the learned systems: when and why a rollout breaks off, or its error at T/2. A script.

    PYTHONPATH=docs/ladder .venv/bin/python tests/validation/stability_map.py runs/ladder VARIANT [VARIANT ...]

Rollouts of trained variants of the ladder over step, Mach number, width of the filter, number of neighbours,
arrangement of the particles at the start, density, frame of reference, precision and weights; one change at a time.
Takes an hour; a stopped script goes on. Flows and further trainings go to runs/stability. Writes stability-map.json
and stability-map.png to the folder docs/validation.
"""

import argparse
import itertools
import json
import math
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path

import h5py
import numpy as np
import torch
from matplotlib.patches import Rectangle
from mpi4py import MPI

import eddies
from eddies.analysis.errors import fluctuations, velocity_error
from eddies.flow.tracers import lattice_positions
from eddies.io.weights import load_weights
from eddies.parallel.slab import SlabDecomposition
from eddies.report.figures import panels, styled
from eddies.report.summary import in_symbols
from eddies.scene.model import WEIGHTS
from eddies.scene.scene import Scene, load_scene
from eddies.spectral.interpolation import SplineInterpolation
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.workflows.ground_truth.truth import GroundTruth, open_truth
from eddies.workflows.rollout.method import TimeStep, make_method

sys.path.append(str(Path(__file__).parents[2] / "docs"))

from pictures import save  # noqa: E402

HERE, OUTPUT = Path(__file__).parent, Path(__file__).parents[2] / "docs" / "validation"
RUNS, SCENE = Path("runs/stability"), HERE / "stability.toml"
SCHEME, USUAL, MOST_STEPS = "corrected-verlet", 0.3, 20_000  # the usual step, in Kolmogorov times
STEPS = (0.01, 0.03, 0.1, 0.3, 0.6, 1.0)
SPEEDS = {0.01: 195.0, 0.04: 48.8, 0.08: 24.4, 0.16: 12.2, 0.5: 3.9}  # by Mach number
SIDES = (56, 32, 16, 12, 7)  # particles per side; the filter is two spacings wide
NEIGHBORS = (8, 20, 60, 150, 300)
UNFIT = "does not fit"  # the radius of the neighbourhood is above half the box
ELSEWHERE = {"paper": "hit-256-paper", "local": "hit-256-local", "resolved": "hit-256"}
State, Outcome = dict[str, np.ndarray], dict[str, float | str]


class Flow:
    """A ground truth with its stored filtered fields, in which particles can start anywhere."""

    def __init__(self, truth: GroundTruth) -> None:
        self.truth, self.scales = truth, truth.scales
        self.turnover, self.fast = (truth.reference[name] for name in ("eddy_turnover_time", "kolmogorov_time"))
        self.half = int(round(0.5 * self.turnover / truth.times[1]))

    def start(self) -> State:
        return self.truth.block(0)

    @cached_property
    def _fields(self) -> tuple[SplineInterpolation, list[np.ndarray]]:
        slab = SlabDecomposition(MPI.COMM_SELF, self.truth.decomposition.length, self.truth.fields.cells)
        grid = SpectralGrid(slab, "float64", (slab.planes - 1) // 2)
        spline = SplineInterpolation(grid, "cubic", 1)
        return spline, [spline.coefficients(grid.forward(np.concatenate(
            [self.truth.planes(self.truth.fields, index, name, slab) for name in ("velocity", "density")])))
            for index in range(len(self.truth.fields.times))]

    def values(self, time: float, position: np.ndarray) -> np.ndarray:
        """Velocity and density (n, 4) of the stored fields at a time, cubic in time, at any positions."""
        spline, rows = self._fields
        times = self.truth.fields.times
        first = min(max(int(np.searchsorted(times, time)) - 2, 0), len(times) - 4)
        nodes = times[first:first + 4]
        weights = [math.prod((time - b) / (a - b) for b in nodes if b != a) for a in nodes]
        inside = position % self.truth.decomposition.length
        return sum(weight * spline.at(rows[first + n], inside) for n, weight in enumerate(weights))

    def at(self, position: np.ndarray) -> State:
        """Particles of the flow at the time 0 at these positions (n, 3)."""
        found = self.values(0.0, position)
        return {"id": np.arange(len(position)), "position": position, "velocity": found[:, :3], "density": found[:, 3]}

    def later(self, position: np.ndarray) -> np.ndarray:
        """Velocities (n, 3) at T/2 of particles that follow the stored fields, by the midpoint rule."""
        count = 4 * self.half
        step = self.truth.times[self.half] / count
        for number in range(count):
            middle = position + step / 2 * self.values(number * step, position)[:, :3]
            position = position + step * self.values((number + 0.5) * step, middle)[:, :3]
        return self.values(count * step, position)[:, :3]


@torch.no_grad()
def outcome(scene: Scene, weights: Path, flow: Flow, start: State | None = None, step: float = USUAL,
            frame: np.ndarray | None = None) -> Outcome:
    """Error and energy at T/2, or time (in T) and cause of a break-off.

    `start` replaces the particles of the truth, and `frame` (3,) is a velocity added to them.
    """
    begin = flow.start() if start is None else start
    moved = begin if frame is None else begin | {"velocity": begin["velocity"] + frame}
    truth, number, until = flow.truth, 0, float(flow.truth.times[flow.half])
    original, truth.particles = truth.particles, lambda _: moved
    try:
        with tempfile.TemporaryDirectory() as place:
            (Path(place) / "model.h5").symlink_to(weights.resolve())
            run = make_method(scene, TimeStep(SCHEME, step * flow.fast), truth, 0, Path(place))
    finally:
        truth.particles = original
    while run.time < until - 1e-9:
        number += 1
        fault = run.advance(until, number)
        if fault is not None or number > MOST_STEPS:
            return {"broken": run.time / flow.turnover, "cause": cause_of(fault or "steps")}
    columns = run.particles.to_numpy()
    velocity = columns["velocity"][np.argsort(columns["id"])] - (0 if frame is None else frame)
    exact = truth.block(flow.half)["velocity"] if start is None else flow.later(begin["position"])
    if not np.isfinite(velocity).all():
        return {"broken": run.time / flow.turnover, "cause": "not finite"}
    return {"error": velocity_error(velocity, exact),
            "energy": float(np.sum(fluctuations(velocity)**2) / np.sum(fluctuations(exact)**2))}


def cause_of(fault: str) -> str:
    """A word for the fault of a rollout."""
    words = {"density differs": "density", "speed above": "speed", "outside": "speed", "not finite": "not finite"}
    return next((word for text, word in words.items() if re.search(text, fault)), fault[:20])


def arrangements(flow: Flow, seed: int = 5) -> dict[str, np.ndarray]:
    """Positions (n, 3) of as many particles as the flow has."""
    length, position = flow.truth.decomposition.length, flow.start()["position"]
    side = round(len(position) ** (1 / 3))
    random = np.random.default_rng(seed)
    crowd = position.copy()
    crowd[::4] = length / 2 + length / 10 * (random.random((len(crowd[::4]), 3)) - 0.5)
    pairs = position.copy()
    pairs[1::2] = pairs[:-1:2][:len(pairs[1::2])]
    return {"lattice": (np.stack(np.meshgrid(*3 * [np.arange(side)], indexing="ij"), -1).reshape(-1, 3) + 0.5)
            * length / side, "near a lattice": lattice_positions(seed, side, 0, side**3, length),
            "a quarter in a thousandth": crowd, "pairs at one place": pairs}


def made(name: str, *overrides: str) -> Path:
    """Make a ground truth of the scene with changes; the run directory. What is complete is kept."""
    return eddies.run(load_scene(SCENE, overrides), stages=("dns",), output=RUNS / name)


def rounded(weights: Path, place: Path) -> Path:
    """A copy of trained weights that are rounded to half precision."""
    place.write_bytes(weights.read_bytes())
    with h5py.File(place, "r+") as file:
        names: list[str] = []
        file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) and "weights" in name
                        and item.dtype.kind == "f" else None)
        for name in names:
            file[name][...] = file[name][...].astype(np.float16).astype(file[name].dtype)
    assert names
    load_weights(MPI.COMM_SELF, place, "model")
    return place


def cases(ladder: Path, chosen: list[str]) -> Iterator[tuple[str, str, str, Callable[[], Outcome]]]:
    """Yield axis, case, variant, and a function that gives the outcome."""
    scene, truth = load_scene(ladder / "scene.toml"), ladder / "realisation-3" / "ground_truth.h5"
    variants = {name: (scene.variant[name], ladder / name / "model.h5") for name in chosen}
    with open_truth(MPI.COMM_SELF, truth) as opened:
        flow = Flow(opened)
        drift, begin = 30 * flow.scales.velocity * np.array([0.6, -0.48, 0.64]), flow.start()
        for name, (own, weights) in variants.items():
            usual = partial(outcome, own, weights, flow)
            for step in STEPS:
                yield "step", f"{step:g} t_η", name, partial(usual, step=step)
            for words, position in arrangements(flow).items():
                yield "start", words, name, partial(usual, flow.at(position))
            for words, density in (("10 % higher", 1.1 * begin["density"]), ("its mean", 0 * begin["density"] + 1)):
                yield "density", words, name, partial(usual, begin | {"density": density})
            yield "boost of", "30 u′", name, partial(usual, frame=drift)
            double = replace(own, simulation=replace(own.simulation, precision="float64"))
            yield "precision", "double", name, partial(outcome, double, weights, flow)
            yield ("precision", "half, of the weights", name,
                   lambda: outcome(own, rounded(weights, RUNS / "half.h5"), flow))
            if name in ELSEWHERE:
                yield ("weights", "of hit-256", name,
                       partial(outcome, own, WEIGHTS / f"{ELSEWHERE[name]}.h5", flow))
    for axis, case, *change in ([("M_t", f"{mach:g}", f"flow.sound_speed={speed}") for mach, speed in SPEEDS.items()]
                                + [("filter", f"{side}³ particles", f"tracers.particles_per_side={side}")
                                   for side in SIDES]):
        run = made(f"{axis}-{case.split('³')[0]}", *change)
        with open_truth(MPI.COMM_SELF, run / "ground_truth.h5") as opened:
            flow = Flow(opened)
            if axis == "filter":
                case = f"{flow.scales.filter_width / flow.scales.kolmogorov_length:.0f} η"
            for name, (own, weights) in variants.items():
                yield axis, case, name, partial(outcome, own, weights, flow)
    base = made("M_t-0.08", f"flow.sound_speed={SPEEDS[0.08]}")
    for name, (own, _) in variants.items():
        if "pairs" in own.model.reads and own.training.horizons is None:
            for number in NEIGHBORS:
                yield "neighbours", str(number), name, partial(with_neighbors, own, name, number, base)


def with_neighbors(own: Scene, name: str, number: int, base: Path) -> Outcome:
    """The outcome of a short training with another number of neighbours, in the flow of the training."""
    place = RUNS / f"{name}-{number}"
    place.mkdir(parents=True, exist_ok=True)
    scene = replace(load_scene(SCENE, ["flow.sound_speed=24.4"]), model=replace(own.model, neighbors=float(number)))
    if not (place / "ground_truth.h5").exists():
        (place / "ground_truth.h5").symlink_to((base / "ground_truth.h5").resolve())
    eddies.run(replace(scene, kernel=None), stages=("train",), output=place)
    with open_truth(MPI.COMM_SELF, place / "ground_truth.h5") as opened:
        return outcome(scene, place / "model.h5", Flow(opened))


@styled
def figure(found: dict[str, dict[str, dict[str, Outcome]]], names: list[str]):
    """One row a case, one column a variant: the error at T/2 as a colour and a number, or time and cause of the end.

    Black: the rollout breaks off. Grey: the neighbourhood does not fit into the box. White: no such case.
    """
    rows = [(axis, case) for axis, each in found.items() for case in each]
    drawn, axes = panels(1, 1, (8.3, 0.21 * len(rows) + 0.8))
    drawn.subplots_adjust(left=0.31, right=0.98, bottom=0.1, top=0.95)
    axis, values = axes[0, 0], np.full((len(rows), len(names)), np.nan)
    for (row, (kind, case)), (column, name) in itertools.product(enumerate(rows), enumerate(names)):
        result = found[kind][case].get(name)
        if result is None:
            continue
        fits, broken = result.get("cause") != UNFIT, "broken" in result
        values[row, column] = np.nan if broken else min(result["error"], 1.0)
        end = f"{result['broken']:.2f} T: {result['cause']}" if broken else f"{result['error']:.2f}"
        axis.text(column, row, end if fits else UNFIT, ha="center", va="center", fontsize=8,
                  color="white" if broken and fits or values[row, column] > 0.55 else "black")
        if broken:
            axis.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, color="black" if fits else "0.85", linewidth=0))
    shown = axis.imshow(values, cmap="viridis_r", vmin=0, vmax=1, aspect="auto")
    axis.set_yticks(range(len(rows)), [in_symbols(case) for _, case in rows], fontsize=8)
    for kind, each in found.items():
        first = rows.index((kind, next(iter(each))))
        axis.axhline(first - 0.5, color="white", linewidth=2)
        axis.text(-0.45, first, in_symbols(kind), transform=axis.get_yaxis_transform(), va="center", fontsize=8)
    axis.set_xticks(range(len(names)), names)
    axis.xaxis.tick_top()
    axis.tick_params(length=0)
    axis.grid(False)
    drawn.colorbar(shown, ax=axis, label="velocity error at T/2", orientation="horizontal", fraction=0.02, pad=0.02)
    return drawn


def main(ladder: Path, chosen: list[str]) -> None:
    RUNS.mkdir(parents=True, exist_ok=True)
    known = RUNS / "found.json"
    found: dict[str, dict[str, dict[str, Outcome]]] = json.loads(known.read_text()) if known.exists() else {}
    for axis, case, name, compute in cases(ladder, chosen):
        results = found.setdefault(axis, {}).setdefault(case, {})
        if name not in results:
            try:
                results[name] = compute()
            except ValueError:
                results[name] = {"broken": 0.0, "cause": UNFIT}
            known.write_text(json.dumps(found))  # a stopped script goes on here
            print(f"{axis}: {case}: {name}: {results[name]}", flush=True)
    (OUTPUT / "stability-map.json").write_text(json.dumps(found, indent=1) + "\n")
    save(OUTPUT / "stability-map.png", figure(found, chosen))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("variants", nargs="+")
    given = parser.parse_args()
    main(given.run, given.variants)
