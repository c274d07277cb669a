"""A-priori tests of a trained model: its rates compared with the truth at times outside the training (Fig. 3)."""

from __future__ import annotations

import numpy as np
import torch

from eddies.analysis.lagrangian import evenly
from eddies.clock import ProgressLine
from eddies.learning.force_training import TrainingFrame
from eddies.parallel.migration import IdOrder, migrate
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.exchanges import relative_error
from eddies.particles.model import FORCING, LagrangianModel
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.spectral.interpolation import SplineInterpolation
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.workflows.ground_truth.frame_counts import TESTED_FRAMES, TESTED_PARTICLES, between_frames
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.learned.model import particles_for
from eddies.workflows.learned.training_data import load_frame


def evaluation_frames(truth: GroundTruth) -> np.ndarray:
    """Frames with a filtered field, evenly spread over the ground truth, that have a frame before and after.

    Raises SceneError if the ground truth has no such frame.
    """
    usable = np.array(between_frames(len(truth.times), truth.field_frames))
    return usable[evenly(len(usable), TESTED_FRAMES)]


@torch.no_grad()
def evaluate(truth: GroundTruth, model: LagrangianModel, frames: np.ndarray, last_seen: int,
             dtype: torch.dtype) -> dict[str, dict[str, np.ndarray]]:
    """Test a model at some frames, and return tables by name; collective.

    `acceleration_sample` and, if learned, `density_rate_sample` hold true and predicted rates at the last frame.
    `a_priori` has a row for each frame, with the `delay` since frame `last_seen` and these normalised L2 errors:

    `acceleration_error`: the model as in a rollout, with the density that its terms give.
    `true_density_acceleration_error`: the model with the true density.
    `density_rate_error`: the learned rate of the density, or the rate of change of the density that terms give.
    `pressure_gradient_error`: no model, but -c^2 grad ln(rho) of the filtered field, plus the forcing if it stays on.
    """
    rows, comm = [], truth.decomposition.comm
    progress = ProgressLine("train", lambda: "in the a-priori test", unit="frame")
    for index in frames:
        frame = load_frame(truth, index, model, dtype)
        errors = frame.errors()
        row = {"delay": truth.times[index] - truth.times[last_seen],
               "acceleration_error": relative_error(comm, errors["acceleration"], frame.acceleration)}
        if "density" in truth.fields.variables:
            exact = _pressure_force(truth, int(index), frame.particles).to(frame.acceleration)
            if FORCING in frame.kept:
                exact = exact + frame.kept[FORCING].at(None).acceleration
            row["pressure_gradient_error"] = relative_error(comm, exact - frame.acceleration, frame.acceleration)
        if model.density_is_given:
            true = torch.from_numpy(truth.particles(int(index))["density"]).to(truth.device)
            given = frame.errors(density=true)["acceleration"]
            row["true_density_acceleration_error"] = relative_error(comm, given, frame.acceleration)
            row["density_rate_error"] = _given_rate_error(truth, frame.dynamics, int(index))
        if "density_rate" in errors:
            row["density_rate_error"] = relative_error(comm, errors["density_rate"], frame.density_rate)
        rows.append(row)
        progress(len(rows) / len(frames), len(rows))
    tables = {"a_priori": {name: np.array([row[name] for row in rows]) for name in rows[0]},
              "acceleration_sample": _sample(truth, frame, frame.acceleration, errors["acceleration"])}
    if "density_rate" in errors:
        tables["density_rate_sample"] = _sample(truth, frame, frame.density_rate, errors["density_rate"])
    return tables


def _given_rate_error(truth: GroundTruth, dynamics: ParticleDynamics, index: int) -> float:
    """Error of the rate of change of the density that terms give, by centred differences along true trajectories."""
    comm, total = truth.decomposition.comm, truth.total

    def density(frame: int) -> np.ndarray:
        particles = particles_for(dynamics.model, truth.particles(frame), truth.device)
        return IdOrder(comm, as_numpy(particles.id), total).apply(as_numpy(dynamics.rates(particles).density))

    rate = (density(index + 1) - density(index - 1)) / (truth.times[index + 1] - truth.times[index - 1])
    columns = truth.particles_with_rates(index)
    exact = IdOrder(comm, columns["id"], total).apply(columns["density_rate"])
    return relative_error(comm, torch.from_numpy(rate - exact), torch.from_numpy(exact))


def _pressure_force(truth: GroundTruth, index: int, particles: ParticleSet) -> torch.Tensor:
    """-c^2 grad ln(rho) of the filtered field at the particles (n, 3)."""
    at = truth.field_frames.index(index)
    slab = SlabDecomposition(truth.decomposition.comm, truth.decomposition.length, truth.fields.cells)
    grid = SpectralGrid(slab, cutoff=(slab.planes - 1) // 2)
    planes = truth.planes(truth.fields, at, "density", slab)
    force = -truth.scales.sound_speed**2 * grid.gradient(grid.forward(np.log(planes))[0])
    spline = SplineInterpolation(grid, "quintic")
    columns = migrate(slab, {name: as_numpy(getattr(particles, name)) for name in ("id", "position")})
    values = spline.at(spline.coefficients(force), columns["position"])
    # The slabs of the fields may differ from those of the particles, so values return to their particles by id.
    order = IdOrder(slab.comm, columns["id"], truth.total)
    back = migrate(truth.decomposition, {"id": np.arange(order.start, order.stop), "value": order.apply(values),
                                         "position": order.apply(columns["position"])})
    row = np.empty(len(particles), np.int64)
    row[np.argsort(as_numpy(particles.id))] = np.argsort(back["id"])
    return torch.from_numpy(back["value"][row])


def _sample(truth: GroundTruth, frame: TrainingFrame, exact: torch.Tensor,
            error: torch.Tensor) -> dict[str, np.ndarray]:
    """True and predicted rates of the particles with the lowest ids, equal on all ranks."""
    columns = {"truth": as_numpy(exact), "predicted": as_numpy(exact + error)}
    ids, sampled = as_numpy(frame.particles.id), min(TESTED_PARTICLES, truth.total)
    chosen = ids < sampled
    whole = {name: np.zeros((sampled, *values.shape[1:])) for name, values in columns.items()}
    for name, values in columns.items():
        whole[name][ids[chosen]] = values[chosen]
    return {name: global_sum(truth.decomposition.comm, values) for name, values in whole.items()}
