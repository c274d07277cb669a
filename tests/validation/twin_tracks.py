"""Fields from tracks of a simulated flow beside the true fields: methods, noise, lost tracks, a volume. A script.

    mpirun -n 2 .venv/bin/eddies dns tests/validation/tracks.toml [--set seed=3 --output runs/tracks-3]
    mpirun -n 2 .venv/bin/python tests/validation/twin_tracks.py hit runs/tracks [runs/tracks-3 ...]
    mpirun -n 2 .venv/bin/eddies dns tests/validation/tracks-256.toml
    mpirun -n 2 .venv/bin/python tests/validation/twin_tracks.py hit-256 runs/tracks-256
    mpirun -n 2 .venv/bin/eddies dns tests/validation/tracks-small.toml
    mpirun -n 2 .venv/bin/python tests/validation/twin_tracks.py hit-small runs/tracks-small

The three flows of the stored results of `hit` have the seeds 2, 3 and 4, and start from the realisations 2, 3 and 4 of
`eddies run compare-hit`. For seed 2 the options are `--unset spin_up --unset forcing --set initial.kind=file --set
initial.path=runs/compare-hit/realisation-2/ground_truth.h5`.

Writes the tracks of each case as a user would have them, reconstructs them, and compares the fields, after the filter
of the stored ones, with these. Then forecasts the flow from the first field: the model `resolved` with weights of
another flow of `hit`, and grids that start from the particles. At last trains `resolved` on tracks of the whole flow.
On the flow of `hit-small` it measures the shares of errors that are within the standard deviations of the error map.
Prints means over the runs, of fields at all times after the first t_eta, and the standard deviations of several runs,
and writes docs/results/tracks-NAME.json.

Each row is kept in twin-NAME.json in the first run directory as soon as it is known. The same command goes on after a
stop, and reads these rows in place of measuring them again; remove the file to do so.
"""

import json
import shutil
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

import eddies

RESULTS = Path(__file__).parents[2] / "docs/results"
BOX = 2 * np.pi
TURNOVER_LOSS = 0.2  # share of the tracks that is lost at random in a turnover


@dataclass(frozen=True)
class Case:
    """A reconstruction: set of tracers, method, and what is done to the tracks.

    noise : standard deviation of a coordinate, over the mean spacing; velocities are then found by splines, as with
    `splines`. lost : whether tracks are lost. inner : side of a volume that is not periodic, over the edge of the cube.
    samples : of the error map. frames : the first ones are used, None for all.
    """

    tracks: str
    method: str = "least-squares"
    noise: float = 0.0
    splines: bool = False
    lost: bool = False
    inner: float = 1.0
    samples: int = 16
    frames: int | None = None


SETS = {"hit": ("whole-8", "whole-16", "whole-32", "filtered-8", "filtered-16", "filtered-32"),
        "hit-256": ("whole-16", "whole-32", "filtered-16", "filtered-32"), "hit-small": ()}
# Those whose error maps are compared with the errors. Where a memory has many modes, fields are those of the sixth and
# ninth frame interval, 1.2 and 1.8 Kolmogorov times after the start.
MAPPED = {"hit-small": [
    *(Case(f"{kind}-{side}", "least-squares", noise, samples=16 if side < 32 else 8)
      for kind in ("whole", "filtered") for side, noise in ((8, 0.0), (16, 0.0), (32, 0.0), (16, 0.1))),
    Case("filtered-8", "memory"), *(Case("filtered-16", "memory", noise, samples=8) for noise in (0.0, 0.1)),
    Case("filtered-32", "memory", samples=8, frames=10),
    *(Case(f"whole-{side}", "memory", noise, samples=4, frames=10)
      for side, noise in ((8, 0.0), (16, 0.0), (32, 0.0), (16, 0.1)))]}
# Done to the tracks of `hit` alone.
FURTHER = [
    *(Case(name, method) for name in ("whole-16", "filtered-32") for method in ("kriging", "average")),
    *(Case("whole-16", method, splines=True) for method in ("least-squares", "memory")),
    *(Case("whole-16", method, noise) for noise in (0.1, 0.3) for method in ("least-squares", "memory")),
    *(Case("whole-16", method, lost=True) for method in ("least-squares", "memory")),
    *(Case("whole-32", method, inner=0.5) for method in ("least-squares", "memory"))]


# A scene that forecasts tracks over half a turnover: its frames are seven eighths of t_eta apart, or less.
FORECAST = """
[model]
preset = "resolved"
path = "{weights}"
[simulation]
start = 0.0
turnovers = 0.55
frame_interval = {interval}
[variant.resolved]
"""
GRID = """
[variant.grid-{cells}]
simulation.method = "eulerian"
eulerian.cells = {cells}
eulerian.start = "particles"
"""
# A scene that learns a model from tracks of the whole flow.
LEARN = """
[model]
preset = "resolved"
[training]
window = 0.4
frames = 8
batch = 1024
steps = 300
[simulation]
frame_interval = 0.1
turnovers = 0.5
[variant.resolved]
"""
LEARNED = {"hit": ("whole-16", "whole-32")}
WEIGHTS = {"hit": {"filtered-16": "eddies:hit-coarse", "filtered-32": "eddies:hit"},
           "hit-256": {"filtered-16": "eddies:hit-256", "filtered-32": "eddies:hit-256"}, "hit-small": {}}
COLUMNS = "velocity_error_early", "velocity_error_half", "velocity_error_end", "end", "wall_seconds"


def write(case: Case, truth: h5py.File, path: Path, seed: int) -> str:
    """Write the tracks of a case; returns the lines of [tracks]."""
    holder, reference = truth["particles/tracers"], truth["reference"].attrs
    times, position = (holder[f"position/{name}"][()] for name in ("time", "value"))
    velocity, draw = holder["velocity/value"][()], np.random.default_rng(seed)
    frame, track = (part.ravel() for part in np.indices(position.shape[:2]))
    kept = frame < (case.frames or len(times))
    if case.lost:
        rate = -np.log(1 - TURNOVER_LOSS) / reference["eddy_turnover_time"]
        kept &= times[frame] < draw.exponential(1 / rate, position.shape[1])[track]
    spacing, half = float(reference["spacing"]), case.inner * BOX / 2
    position = position[frame, track] + case.noise * spacing * draw.standard_normal((frame.size, 3))
    lines = [f'path = "{path.name}"', f"filter_width = {float(reference['filter_width'])}",
             f"viscosity = {float(reference['viscosity'])}", f"filtered = {str(case.tracks[0] == 'f').lower()}"]
    if case.inner < 1:
        kept &= (np.abs(position - np.pi) < half).all(1)
        lines.append(f"volume = {[float(np.pi - half), float(np.pi + half)] * 3}")
    else:
        position, lines = position % BOX, [*lines, f"box = {BOX}"]
    splines = case.noise > 0 or case.splines
    if case.noise:
        lines.append(f"noise = {case.noise * spacing}")
    eddies.write_tracks(path, times[frame[kept]], track[kept], position[kept],
                        None if splines else velocity[frame, track][kept])
    return "\n".join(lines)


def errors_of(case: Case, directory: Path, truth: h5py.File) -> dict[str, np.ndarray]:
    """Errors of filtered velocity, gradient and pressure over the frames whose fields are stored, and the estimate.

    The true pressure over the density is that of the density, c^2 (rho - <rho>) / <rho>: these flows have no sound.
    """
    reference = truth["reference"].attrs
    found: dict[str, list[float]] = defaultdict(list)
    with h5py.File(directory / "reconstruction.h5") as file:
        edge = BOX * float(file["about"].attrs["length_unit"])
        corner, fields = file["about"].attrs["corner"], file["fields/reconstructed"]
        times, cells = fields["time"][()], fields.attrs["cells"]
        width = 0.0 if case.tracks[0] == "f" else float(reference["filter_width"])
        filtered = truth["fields/filtered"]
        for time, exact, density in zip(filtered["time"][()], filtered["velocity"], filtered["density"]):
            frame = int(np.argmin(np.abs(times - time)))
            if abs(times[frame] - time) > 1e-6 or time < float(reference["kolmogorov_time"]):
                continue
            axis = np.arange(cells) / cells * BOX
            inside = np.flatnonzero(np.abs(axis - np.pi) <= case.inner * BOX / 2 * (1 if case.inner == 1 else 0.9))
            own = at_points(fields["velocity"][frame], edge, axis[inside] + corner[0], width**2)
            true = at_points(exact, BOX, axis[inside])
            pressure = at_points(fields["pressure"][frame], edge, axis[inside] + corner[0], width**2)[0]
            by_density = at_points(density, BOX, axis[inside])[0] * float(reference["sound_speed"]) ** 2
            pairs = {"velocity": (own[0], true[0]), "gradient": (own[1], true[1]),
                     "pressure": (pressure - pressure.mean(), by_density - by_density.mean())}
            for name, (mine, exact_one) in pairs.items():
                found[f"{name}_error"].append(np.linalg.norm(mine - exact_one) / np.linalg.norm(exact_one))
        table = file["errors_over_time"]
        late = table["time"][()] > float(reference["kolmogorov_time"])
        found["validation_error"] = list(table["validation_error"][late])
        found["seconds"] = list(table["seconds"][late])
    return {name: np.array(values) for name, values in found.items()}


def at_points(field: np.ndarray, edge: float, places: np.ndarray, width_squared: float = 0.0,
              highest: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
    """A field (components, z, y, x) on a periodic cube and its gradient, at points of a grid, after a Gaussian filter.
    A filter of negative `width_squared` undoes one. Modes beyond the wavenumber `highest`, in units of the smallest,
    are left out.
    """
    cells = field.shape[1]
    number = np.fft.fftfreq(cells, 1 / cells) * (np.abs(np.fft.fftfreq(cells, 1 / cells)) < cells / 2)
    k = 2 * np.pi / edge * number
    squared = k[:, None, None]**2 + k[:, None]**2 + k**2
    modes = np.fft.fftn(field, axes=(1, 2, 3)) / cells**3 * np.exp(-squared * width_squared / 24)
    modes *= squared <= (2 * np.pi / edge * (highest + 1e-9)) ** 2
    waves = np.exp(1j * np.multiply.outer(places, k))

    def values(of: np.ndarray) -> np.ndarray:
        return np.einsum("...zyx,iz,jy,kx->...ijk", of, waves, waves, waves, optimize=True).real

    return values(modes), np.stack([values(modes * 1j * along) for along in (k, k[:, None], k[:, None, None])], 1)


@contextmanager
def made(case: Case, run: Path, seed: int, rest: str, stages: Sequence[str] | None = None) -> Iterator[Path]:
    """Run stages of a scene of the tracks of a case, with the sections `rest`. Yields the run directory, which is
    removed at the end. Collective."""
    comm = MPI.COMM_WORLD
    path = Path(comm.bcast(tempfile.mkdtemp() if comm.rank == 0 else None))
    if comm.rank == 0:
        with h5py.File(run / case.tracks / "ground_truth.h5") as truth:
            lines = write(case, truth, path / "tracks.h5", seed)
        (path / "scene.toml").write_text(f"[tracks]\n{lines}\n{rest}")
    comm.Barrier()
    eddies.run(path / "scene.toml", stages=stages, output=path / "run", comm=comm)
    yield path / "run"
    comm.Barrier()
    if comm.rank == 0:  # a gigabyte
        shutil.rmtree(path)


def fields_of(case: Case, run: Path, seed: int) -> dict[str, float]:
    """Mean errors of the reconstructed fields of a case; collective."""
    comm, found = MPI.COMM_WORLD, None
    with h5py.File(run / case.tracks / "ground_truth.h5") as truth:
        cells = 2 * truth["fields/filtered"].attrs["cells"]
        rest = f'[reconstruction]\nmethod = "{case.method}"\ncells = {cells}\nfields = ["velocity", "pressure"]\n'
        with made(case, run, seed, rest, ["dns", "reconstruct"]) as directory:
            if comm.rank == 0:
                found = {name: values.mean() for name, values in errors_of(case, directory, truth).items()}
    return comm.bcast(found)


def within_of(case: Case, run: Path, seed: int) -> dict[str, float]:
    """Compare the error map of a case with the errors (`shares_within`); collective."""
    comm, found = MPI.COMM_WORLD, None
    with h5py.File(run / case.tracks / "ground_truth.h5") as truth:
        filtered, times = truth["fields/filtered"], truth["particles/tracers/position/time"]
        every = 1 if case.method == "memory" else round(filtered["time"][1] / times[1])
        rest = (f'[reconstruction]\nmethod = "{case.method}"\ncells = {filtered.attrs["cells"]}\nevery = {every}\n'
                f'fields = ["velocity", "gradient"]\nsamples = {case.samples}\nholdout = 0\n')
        with made(case, run, seed, rest, ["dns", "reconstruct"]) as directory:
            if comm.rank == 0:
                found = shares_within(case, directory, truth)
    return comm.bcast(found)


def shares_within(case: Case, directory: Path, truth: h5py.File) -> dict[str, float]:
    """Shares of the errors of velocity and gradient at grid points that are within one and two standard deviations of
    the error map, and the rms of the deviations over that of the errors.

    The true field is the stored one, for tracks of the whole flow with the filter undone, as far as the modes of the
    reconstruction reach.
    """
    reference, filtered = truth["reference"].attrs, truth["fields/filtered"]
    undone = 0.0 if case.tracks[0] == "f" else -float(reference["filter_width"]) ** 2
    found: dict[str, list[float]] = defaultdict(list)
    with h5py.File(directory / "reconstruction.h5") as file:
        fields, highest = file["fields/reconstructed"], file["about"].attrs["highest_wavenumber"]
        axis = np.arange(fields.attrs["cells"]) / fields.attrs["cells"] * BOX
        for time, exact in zip(filtered["time"][()], filtered["velocity"]):
            frame = int(np.argmin(np.abs(fields["time"][()] - time)))
            if abs(fields["time"][frame] - time) > 1e-6 or time < float(reference["kolmogorov_time"]):
                continue
            for name, true in zip(("velocity", "gradient"), at_points(exact, BOX, axis, undone, highest)):
                deviation = fields[f"{name}_deviation"][frame]
                error = np.abs(fields[name][frame] - true.reshape(deviation.shape))
                for number in (1, 2):
                    found[f"{name}_within_{number}"].append((error < number * deviation).mean())
                found[f"{name}_deviation_over_error"].append(np.sqrt((deviation**2).mean() / (error**2).mean()))
    return {name: float(np.mean(values)) for name, values in found.items()}


def forecasts_of(tracks: str, weights: str, run: Path, seed: int) -> dict[str, dict[str, float | None]]:
    """Errors and seconds a turnover of the forecasts of a set of tracks, by method; collective."""
    with h5py.File(run / tracks / "ground_truth.h5") as truth:
        times, limit = truth["particles/tracers/position/time"][:2], float(truth["reference"].attrs["kolmogorov_time"])
    step = float(times[1] - times[0])
    rest = FORECAST.format(weights=weights, interval=step * int(limit / step))
    rest += "".join(GRID.format(cells=cells) for cells in (32, 48))
    with made(Case(tracks), run, seed, rest) as directory:
        rows = json.loads((directory / "report/metrics.json").read_text(encoding="utf-8"))["rows"]
    return {row["name"]: {key: row[key] for key in COLUMNS} for row in rows}


def learned_of(tracks: str, run: Path, seed: int) -> dict[str, float | None]:
    """Errors of the particles that follow the fields of tracks of the whole flow, and of `resolved` trained on them.

    The particles are compared with filtered tracers of the simulation that start at the same places: velocities, and
    accelerations as central differences, mean over the frames after t_eta. `resolved` is compared with the particles.
    Collective.
    """
    comm, found, side = MPI.COMM_WORLD, {}, tracks.partition("-")[2]
    with made(Case(tracks), run, seed, LEARN) as directory:
        if comm.rank == 0:
            with h5py.File(directory / "ground_truth.h5") as own, h5py.File(
                    run / f"filtered-{side}/ground_truth.h5") as true:
                velocities = [file["particles/tracers/velocity/value"][()] for file in (own, true)]
                times = own["particles/tracers/velocity/time"][()]
                late = times[1:-1] > true["reference"].attrs["kolmogorov_time"]
            for name, values in {"velocity": [each[1:-1] for each in velocities],
                                 "acceleration": [each[2:] - each[:-2] for each in velocities]}.items():
                mine, exact = (each[late] for each in values)
                found[f"particle_{name}_error"] = float(np.mean(
                    np.linalg.norm(mine - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))))
            row, = json.loads((directory / "report/metrics.json").read_text(encoding="utf-8"))["rows"]
            found |= {key: row[key] for key in COLUMNS}
    return comm.bcast(found)


def combined(found: list[dict[str, float | None]]) -> dict[str, float]:
    """Means, and standard deviations of several runs, of the numbers that all of them have."""
    values = {name: [each[name] for each in found] for name in found[0]}
    values = {name: each for name, each in values.items() if None not in each}
    spreads = {f"{name}_spread": float(np.std(each, ddof=1)) for name, each in values.items() if len(found) > 1}
    return {name: float(np.mean(each)) for name, each in values.items()} | spreads


class Rows:
    """Rows of tables by a name, in a file: a row that is known is not measured again."""

    def __init__(self, path: Path) -> None:
        self._path, self._comm = path, MPI.COMM_WORLD
        self._known = self._comm.bcast(json.loads(path.read_text(encoding="utf-8"))
                                       if self._comm.rank == 0 and path.exists() else {})

    def of(self, name: str, measure: Callable[[], Any]) -> Any:
        """Return the row with this name, which `measure` makes on all ranks if it is not known; collective."""
        if name not in self._known:
            self._known[name] = measure()
            if self._comm.rank == 0:
                self._path.write_text(json.dumps(self._known, default=float), encoding="utf-8")
        return self._known[name]


def main(name: str, runs: list[Path]) -> None:
    """Run all cases and forecasts on some flows of the scene `name`."""
    cases = [Case(tracks, method) for tracks in SETS[name] for method in ("least-squares", "memory")]
    cases += FURTHER if name == "hit" else []
    rows = Rows(runs[0] / f"twin-{name}.json")

    def on_all(measure: Callable[..., Any], *what: Any) -> list[Any]:
        return [rows.of(f"{measure.__name__} {what} {run}", partial(measure, *what, run, seed))
                for seed, run in enumerate(runs)]

    fields = [case.__dict__ | combined(on_all(fields_of, case)) for case in cases]
    forecasts = []
    for tracks, weights in WEIGHTS[name].items():
        found = on_all(forecasts_of, tracks, weights)
        forecasts += [{"tracks": tracks, "method": method} | combined([each[method] for each in found])
                      for method in found[0]]
    learned = [{"tracks": tracks} | combined(on_all(learned_of, tracks)) for tracks in LEARNED.get(name, ())]
    mapped = [case.__dict__ | combined(on_all(within_of, case)) for case in MAPPED.get(name, ())]
    results = {"fields": fields, "forecasts": forecasts, "learned": learned, "mapped": mapped}
    if MPI.COMM_WORLD.rank == 0:
        text = json.dumps({key: table for key, table in results.items() if table}, indent=1) + "\n"
        (RESULTS / f"tracks-{name}.json").write_text(text, encoding="utf-8")
        for row in chain(*results.values()):
            print(row)


if __name__ == "__main__":
    main(sys.argv[1], [Path(path) for path in sys.argv[2:]])
