"""Decaying isotropic turbulence beside a direct simulation of 512^3 cells. A script.

    mpirun -n 2 .venv/bin/eddies dns tests/validation/wray.toml
    python tests/validation/decaying.py runs/wray

The run starts from the spectrum of the reference at t = 2.977 with random phases. Its transfer of energy needs about
one unit of time to recover, so the comparison begins at t = 4. Prints energy, enstrophy, skewness and the exponent n of
the decay, E ~ (t - t_0)^-n, as a Markdown table.
"""

import sys
from pathlib import Path

import numpy as np
from mpi4py import MPI

from eddies.io.hdf5 import open_product, read_table

# A. A. Wray (1997), case HOM02 of AGARD Advisory Report 345, nu = 3.5014e-4: energy, enstrophy <omega^2> and skewness
# of the longitudinal velocity gradient over time.
VISCOSITY, START = 3.5014e-4, 2.977
TIMES = (3.992, 5.028, 5.719)
REFERENCE = {"energy": (0.06924, 0.05027, 0.04223), "enstrophy": (70.20, 38.82, 28.40),
             "skewness": (-0.514, -0.515, -0.517)}


def exponent(time: np.ndarray, energy: np.ndarray, enstrophy: np.ndarray) -> float:
    """1/(d(E/eps)/dt) by least squares; E/eps = (t - t_0)/n where the energy decays with a power of time."""
    return float(1 / np.polyfit(time, energy / (VISCOSITY * enstrophy), 1)[0])


def table(columns: dict[str, np.ndarray]) -> str:
    """The rows of a run beside the reference, as Markdown."""
    time = START + columns["time"]
    own = {"energy": columns["energy"], "enstrophy": columns["dissipation_rate"] / VISCOSITY,
           "skewness": columns["skewness"]}
    lines = ["| | t | 512³ cells | here |", "|---|---|---|---|"]
    for name, published in REFERENCE.items():
        for moment, value in zip(TIMES, published):
            lines.append(f"| {name} | {moment:g} | {value:.4g} | {np.interp(moment, time, own[name]):.4g} |")
    late = (time > TIMES[0]) & (time < TIMES[-1])
    energy, enstrophy = (np.array(REFERENCE[name]) for name in ("energy", "enstrophy"))
    lines.append(f"| exponent of the decay | {TIMES[0]:g} to {TIMES[-1]:g} | "
                 f"{exponent(np.array(TIMES), energy, enstrophy):.3g} | "
                 f"{exponent(time[late], own['energy'][late], own['enstrophy'][late]):.3g} |")
    resolution = np.interp(TIMES[0], time, columns["kmax_eta"]), columns["kmax_eta"][-1]
    lines.append(f"| resolution k_max η | {TIMES[0]:g}, end | | {resolution[0]:.2f}, {resolution[1]:.2f} |")
    return "\n".join(lines)


if __name__ == "__main__":
    with open_product(MPI.COMM_SELF, Path(sys.argv[1]) / "ground_truth.h5", "ground_truth") as file:
        print(table(read_table(file, "statistics")))
