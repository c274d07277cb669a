"""A-priori tests of a trained model: comparison of its rates with the true rates in the whole ground truth (Fig. 3)."""

from __future__ import annotations

import numpy as np
import torch

from eddies.analysis.lagrangian import evenly
from eddies.clock import ProgressLine
from eddies.io.hdf5 import Table
from eddies.learning.force_training import TrainingFrame
from eddies.parallel.migration import IdOrder, migrate
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.exchanges import relative_error
from eddies.particles.model import FORCING, LagrangianModel
from eddies.particles.particle_set import as_numpy
from eddies.spectral.interpolation import SplineInterpolation
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.workflows.ground_truth.frame_counts import TESTED_FRAMES, TESTED_PARTICLES, between_frames
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.learned.model import particles_for
from eddies.workflows.learned.training_data import load_frame


@torch.no_grad()
def evaluate(truth: GroundTruth, model: LagrangianModel, last_seen: int,
             dtype: torch.dtype) -> dict[str, Table]:
    """Test a model at frames with a filtered field, and return tables by name; collective.

    The frames are evenly spread over the ground truth. `acceleration_sample` holds true and predicted accelerations at
    the last of these frames. If the model learns the rate of the density, `density_rate_sample` holds this rate in the
    same way. `a_priori` has a row for each frame, with the `delay` since frame `last_seen`, negative before it, and
    these normalised L2 errors:

    `acceleration_error`: of the model's acceleration as in a rollout, with the density that its terms give.
    `true_density_acceleration_error`: of the model's acceleration with the true density.
    `density_rate_error`: of the learned rate of the density, or of the rate of change of the density that terms give.
    `pressure_gradient_error`: of the acceleration -c^2 grad ln(rho) of the filtered field, without a model. If the flow
    is forced after the release of the tracers, the forcing is added.
    """
    rows, comm = [], truth.decomposition.comm
    usable = np.array(between_frames(len(truth.times), truth.field_frames))
    frames = usable[evenly(len(usable), TESTED_FRAMES)]
    progress = ProgressLine("train", lambda: "in the a-priori test", unit="frame")
    for index in frames:
        frame = load_frame(truth, index, model, dtype)
        errors = frame.errors()
        row = {"delay": truth.times[index] - truth.times[last_seen],
               "acceleration_error": relative_error(comm, errors["acceleration"], frame.acceleration)}
        if "density" in truth.fields.variables:
            row["pressure_gradient_error"] = _pressure_error(truth, int(index), frame)
        if model.density_is_given:
            true = torch.from_numpy(truth.particles(int(index))["density"]).to(truth.device)
            given = frame.errors(density=true)["acceleration"]
            row["true_density_acceleration_error"] = relative_error(comm, given, frame.acceleration)
            row["density_rate_error"] = _given_rate_error(truth, frame.dynamics, int(index))
        if "density_rate" in errors:
            row["density_rate_error"] = relative_error(comm, errors["density_rate"], frame.density_rate)
        rows.append(row)
        progress(len(rows) / len(frames), len(rows))
    tables = {"a_priori": Table({name: np.array([row[name] for row in rows]) for name in rows[0]},
                                units={"delay": "T"}),
              "acceleration_sample": _sample(truth, frame, frame.acceleration, errors["acceleration"], "L/T^2")}
    if "density_rate" in errors:
        tables["density_rate_sample"] = _sample(truth, frame, frame.density_rate, errors["density_rate"],
                                                "M/L^3/T")
    return tables


def _given_rate_error(truth: GroundTruth, dynamics: ParticleDynamics, index: int) -> float:
    """Return the normalised L2 error of the rate of change of the density that terms give. The rate is a centred
    difference along true trajectories."""
    comm, total = truth.decomposition.comm, truth.total

    def density(frame: int) -> np.ndarray:
        particles = particles_for(dynamics.model, truth.particles(frame), truth.device)
        return IdOrder(comm, as_numpy(particles.id), total).apply(as_numpy(dynamics.rates(particles).density))

    rate = (density(index + 1) - density(index - 1)) / (truth.times[index + 1] - truth.times[index - 1])
    columns = truth.particles_with_rates(index)
    exact = IdOrder(comm, columns["id"], total).apply(columns["density_rate"])
    return relative_error(comm, torch.from_numpy(rate - exact), torch.from_numpy(exact))


def _pressure_error(truth: GroundTruth, index: int, frame: TrainingFrame) -> float:
    """Return the error `pressure_gradient_error` of `evaluate` at a frame; collective."""
    acceleration, device = frame.acceleration, frame.acceleration.device
    forcing = frame.kept[FORCING].at(None).acceleration if FORCING in frame.kept else torch.zeros_like(acceleration)
    slab = SlabDecomposition(truth.decomposition.comm, truth.decomposition.length, truth.fields.cells)
    grid = SpectralGrid(slab, cutoff=(slab.planes - 1) // 2)
    planes = truth.planes(truth.fields, truth.field_frames.index(index), "density", slab)
    force = -truth.scales.sound_speed**2 * grid.gradient(grid.forward(np.log(planes))[0])
    spline = SplineInterpolation(grid, "quintic")
    # The slabs of the fields may differ from those of the particles, so the particles move to the fields.
    columns = migrate(slab, {"id": as_numpy(frame.particles.id), "position": as_numpy(frame.particles.position),
                             "acceleration": as_numpy(acceleration), "forcing": as_numpy(forcing)})
    exact = torch.from_numpy(spline.at(spline.coefficients(force), columns["position"])).to(acceleration)
    own, given = (torch.from_numpy(columns[name]).to(device) for name in ("acceleration", "forcing"))
    return relative_error(slab.comm, exact + given - own, acceleration)


def _sample(truth: GroundTruth, frame: TrainingFrame, exact: torch.Tensor, error: torch.Tensor, units: str) -> Table:
    """Return the true and the predicted rates of the particles with the lowest ids, the same arrays on all ranks.
    `error` is the predicted rate minus the true rate."""
    comm = truth.decomposition.comm
    order = IdOrder(comm, as_numpy(frame.particles.id), truth.total)
    own = max(TESTED_PARTICLES - order.start, 0)
    columns = {"truth": as_numpy(exact.double()), "predicted": as_numpy((exact + error).double())}
    return Table({name: np.concatenate(comm.allgather(order.apply(values)[:own])) for name, values in columns.items()},
                 "particle xyz", dict.fromkeys(columns, units))
