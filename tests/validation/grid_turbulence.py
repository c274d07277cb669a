"""Decaying grid turbulence beside the experiment of Comte-Bellot and Corrsin. A script.

    mpirun -n 2 .venv/bin/eddies run cbc
    python tests/validation/grid_turbulence.py runs/cbc [--output docs/validation]

The flows start from the spectrum measured at t U0/M = 42. The truth at 98 and 171 is the measured spectrum, filtered as
the particles' velocity is. Prints, for each variant, the energy up to k_d over that of the filtered experiment and the
rms of ln(E/E_experiment), means and standard deviations over the realisations, and draws the spectra.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from eddies.report.figures import BLUE, DNS, FOURTH, MODEL, SECOND, THIRD, letter, number_wavenumbers, panels, styled
from eddies.spectral.mode_operators import gaussian_transfer
from eddies.stored_run import open_run

# G. Comte-Bellot, S. Corrsin, J. Fluid Mech. 48, 273 (1971), Table 3: k (1/cm) and E (cm^3/s^2) at t U0/M = 98 and 171,
# behind a grid of mesh M = 5.08 cm in a wind of U0 = 10 m/s.
WAVENUMBER = (0.11, 0.15, 0.20, 0.25, 0.30, 0.40, 0.50, 0.70, 1.00, 1.50, 2.00, 2.50, 3.00, 4.00)
ENERGY = {98: (25, 55, 106, 196, 195, 202, 168, 127, 79.2, 47.8, 34.6, 28.6, 23.1, 14.3),
          171: (20, 49.7, 92.0, 120, 125, 98.0, 81.5, 60.2, 39.4, 24.1, 16.5, 12.5, 9.12, 5.62)}
LENGTH, SPEED, MESH, WIND = 11 * 5.08 / (2 * np.pi), 22.2, 5.08, 1000.0  # units of the scene; cm and cm/s
COLOURS = (MODEL, SECOND, FOURTH, THIRD, DNS)


def filtered_experiment(station: int, shells: np.ndarray, filter_width: float) -> np.ndarray:
    """E(k) of the filtered experiment in units of the scene."""
    logarithm = np.interp(np.log(shells), np.log(np.array(WAVENUMBER) * LENGTH), np.log(ENERGY[station]))
    return np.exp(logarithm) / (SPEED**2 * LENGTH) * gaussian_transfer(shells**2, filter_width) ** 2


def time_of(station: int) -> float:
    """Time since the first station in units of the scene."""
    return (station - 42) * MESH / WIND / (LENGTH / SPEED)


def spectra(directory: Path, variant: str, realisations: tuple[int, ...], station: int,
            shells: np.ndarray) -> np.ndarray:
    """E(k) (realisations, shells) of the rollouts at the frame nearest to a station."""
    runs = [open_run(directory / variant / f"realisation-{seed}") for seed in realisations]
    return np.array([run.spectrum("model", time_of(station)).values[shells.astype(int)] for run in runs])


def cell(values: np.ndarray) -> str:
    """Mean and standard deviation over realisations."""
    return f"{values.mean():.3f} ± {values.std(ddof=1):.3f}"


@styled
def draw(found: dict[str, dict[int, np.ndarray]], grids: set[str], shells: np.ndarray, filter_width: float) -> Figure:
    """Mean spectra of all variants at both stations, with the filtered experiment; dashed: those of grids."""
    figure, axes = panels(1, 2, (4.2, 3.4))
    order = sorted(found, key=lambda name: name in grids)  # grids last
    count = len(found) - len(grids)
    colours = dict(zip(order, [*COLOURS[:count], *COLOURS[:len(grids)]]))
    for axis, station in zip(axes.flat, ENERGY):
        axis.loglog(shells, filtered_experiment(station, shells, filter_width), "o", color=BLUE, label="experiment")
        for name in order:
            axis.loglog(shells, found[name][station].mean(0), "--" if name in grids else "-", color=colours[name],
                        label=name)
        axis.set(title=f"$t U_0/M = {station}$", xlabel="$k$", ylabel="$E(k)$")
        number_wavenumbers(axis)
    axes.flat[0].legend(fontsize=7)
    letter(axes.flat)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", metavar="DIR", type=Path)
    parser.add_argument("--output", metavar="DIR", type=Path, default=Path("runs/validation"))
    given = parser.parse_args()
    scene = open_run(given.run).scene
    filter_width = scene.tracers.filter_width
    shells = np.arange(1.0, np.pi / filter_width + 0.5)
    found = {name: {station: spectra(given.run, name, scene.realisations, station, shells) for station in ENERGY}
             for name in scene.variant}
    print("| | energy at 98 | rms of logarithms at 98 | energy at 171 | rms at 171 |\n|---|---|---|---|---|")
    for name, of_stations in found.items():
        cells = []
        for station, spectrum in of_stations.items():
            truth = filtered_experiment(station, shells, filter_width)
            rms = np.sqrt(np.mean(np.log(spectrum / truth) ** 2, axis=1))
            cells += [cell(spectrum.sum(1) / truth.sum()), cell(rms)]
        print(f"| `{name}` | {' | '.join(cells)} |")
    given.output.mkdir(parents=True, exist_ok=True)
    grids = {name for name, variant in scene.variant.items() if variant.simulation.on_grid}
    draw(found, grids, shells, filter_width).savefig(given.output / "grid-turbulence.png", dpi=100, facecolor="white")


if __name__ == "__main__":
    main()
