"""How well particles tell the acceleration that they should have, with nothing fitted. A script, minutes long.

    python tests/validation/closure.py RUN [RUN ...] [--output runs/validation]

On the ground truths of run directories, at the middle of each: the error of the acceleration by pressure, hidden stress
and molecular viscosity over the highest resolved wavenumber k_c, for several weights of the noise that is expected
beyond; over the iterations of the solve, from nothing; and by the gradient model of the stress. Writes closure.json
and closure.png.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from mpi4py import MPI

from eddies.io.hdf5 import open_product
from eddies.io.trajectories import Trajectory
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.flow_units import FlowUnits, resolved_wavenumber
from eddies.particles.fourier_grid import FourierGrid
from eddies.particles.model import build_model
from eddies.particles.particle_set import ParticleSet
from eddies.particles.resolved_velocity import WEIGHT, ResolvedVelocity
from eddies.report.figures import (BLUE, DNS, FOURTH, GUIDE, MODEL, SECOND, legend_at_foot, letter, panels,
                                   plain_log_ticks, png, styled)
from eddies.scene.terms import Pressure, Stress, Viscosity
from eddies.workflows.ground_truth.truth import GroundTruth

SHARES = (0.75, 0.875, 1.0, 1.125, 1.25, 1.375, 1.5, 1.625)
WEIGHTS = {WEIGHT / 10: FOURTH, WEIGHT: MODEL, 10 * WEIGHT: SECOND}
ITERATIONS = (2, 4, 6, 8, 12, 16, 24, 32, 48, 64)
TIGHT = 1e-4


class Known:
    """A frame of a ground truth, with what the terms make of it."""

    def __init__(self, truth, frame):
        self.slab, self.scales = truth.decomposition, truth.scales
        columns = truth.particles_with_rates(frame)
        self.particles, self.exact = ParticleSet.from_numpy(columns), torch.from_numpy(columns["acceleration"])
        self.nyquist = np.pi / self.scales.spacing
        self.chosen = resolved_wavenumber(self.scales.spacing, self.scales.filter_width, self.scales.kolmogorov_length)

    @torch.no_grad()
    def error(self, highest, weight=WEIGHT, iterations=None, form="deconvolution"):
        """Relative error of the acceleration, and the iterations that the solve took."""
        settings = {"pressure": Pressure(), "stress": Stress(form=form), "viscosity": Viscosity()}
        model = build_model(settings, settings, FlowUnits(self.scales, self.scales.filter_width, 60.0))
        dynamics = ParticleDynamics(self.slab, model, 0.0)
        resolution = ResolvedVelocity(FourierGrid(self.slab, int(highest)), self.scales.filter_width,
                                      self.scales.kolmogorov_length, weight)
        resolution.tolerance, resolution.iterations, dynamics.resolution = TIGHT, iterations, resolution
        context = dynamics.context(self.particles)
        missed = model.rates(context).acceleration - self.exact
        return float(missed.norm() / self.exact.norm()), context.resolved.iterations


def measure(path, shares=SHARES, iterations=ITERATIONS):
    """All errors of a run directory's ground truth, ready for JSON."""
    with open_product(MPI.COMM_SELF, Path(path) / "ground_truth.h5", "ground_truth") as file:
        side = round(Trajectory(file, "tracers").total ** (1 / 3))
        # Two cells a particle, so that the largest of the wavenumbers fits in.
        truth = GroundTruth(file, MPI.COMM_SELF, planes=2 * side)
        known = Known(truth, len(truth.times) // 2)
    highest = [int(share * known.nyquist) for share in shares]
    return {
        "particles": side**3, "filter_width_over_eta": known.scales.filter_width / known.scales.kolmogorov_length,
        "nyquist": known.nyquist, "chosen": int(known.chosen), "highest": highest,
        "by_weight": {f"{weight:g}": [known.error(k, weight) for k in highest] for weight in WEIGHTS},
        "gradient": [known.error(k, form="gradient") for k in highest],
        "iterations": list(iterations),
        "by_iterations": [known.error(known.chosen, iterations=number)[0] for number in iterations],
    }


@styled
def figure(found):
    """Errors over k_c, a panel each, and over iterations."""
    drawn, axes = panels(-(-(len(found) + 1) // 2), 2, (4.6, 3.1))
    *cases, solved = axes.flat[:len(found) + 1]
    markers = iter(("o-", "s--", "^:"))
    for (name, case), axis in zip(found.items(), cases):
        share = np.array(case["highest"]) / case["nyquist"]
        for weight, colour in WEIGHTS.items():
            errors = np.array(case["by_weight"][f"{weight:g}"])[:, 0]
            axis.plot(share, errors, "o-", color=colour, markersize=3.5, label=f"weight {weight:g}")
        axis.plot(share, np.array(case["gradient"])[:, 0], "s--", color=BLUE, markersize=3.5, label="gradient stress")
        axis.axvline(case["chosen"] / case["nyquist"], color=GUIDE, linewidth=0.8, label="the choice")
        axis.set(yscale="log", xlabel="$k_c$ / Nyquist wavenumber", ylabel="error of the acceleration", title=name)
        solved.plot(case["iterations"], case["by_iterations"], next(markers), color=DNS, markersize=4,
                    label=name.split(", ")[-1])
    solved.set(xscale="log", yscale="log", xlabel="iterations from zero", title="at the choice of $k_c$")
    solved.set_xticks([2, 4, 8, 16, 32, 64], [2, 4, 8, 16, 32, 64])
    solved.minorticks_off()
    solved.legend(loc="upper right")
    plain_log_ticks(*(axis.yaxis for axis in (*cases, solved)))
    for unused in axes.flat[len(found) + 1:]:
        unused.set_axis_off()
    letter([*cases, solved])
    legend_at_foot(drawn, cases[0])
    return drawn


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--output", type=Path, default=Path("runs/validation"))
    given = parser.parse_args()
    found = {}
    for run in given.runs:
        case = measure(run)
        found[f"{run.name}, d = {case['filter_width_over_eta']:.2g} η"] = case
    given.output.mkdir(parents=True, exist_ok=True)
    (given.output / "closure.json").write_text(json.dumps(found, indent=1) + "\n")
    (given.output / "closure.png").write_bytes(png(figure(found)))
    for name, case in found.items():
        errors = {weight: min(row[0] for row in rows) for weight, rows in case["by_weight"].items()}
        print(f"{name}: k_c {case['chosen']}, least errors by weight {errors}")


if __name__ == "__main__":
    main()
