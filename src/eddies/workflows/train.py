"""Train the particle model on tracers of the training window, or take the weights of another run.

The model is then tested a priori over the whole ground truth.
"""

import logging
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from eddies.analysis.lagrangian import evenly
from eddies.clock import ProgressLine
from eddies.io.checkpoint import Guard
from eddies.io.hdf5 import Table
from eddies.io.new_files import write_files
from eddies.io.provenance import product_provenance
from eddies.io.weights import StoredWeights, save_weights
from eddies.learning.force_training import TrainingFrame
from eddies.learning.training import Training
from eddies.parallel.broadcast import on_first_rank
from eddies.parallel.communicator import Comm
from eddies.parallel.migration import IdOrder, migrate
from eddies.parallel.slab import SlabDecomposition
from eddies.parallel.stop import StopRequest
from eddies.particles.devices import prepare_torch
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.exchanges import relative_error
from eddies.particles.model import FORCING, LagrangianModel
from eddies.particles.particle_set import as_numpy
from eddies.pipeline import STAGES
from eddies.scene.scene import Scene
from eddies.spectral.interpolation import SplineInterpolation
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.workflows.ground_truth.frame_counts import TESTED_FRAMES, TESTED_PARTICLES, between_frames, last_seen
from eddies.workflows.ground_truth.truth import GroundTruth, open_truth
from eddies.workflows.learned.model import particles_for, trained_model
from eddies.workflows.learned.source import ModelDefinition, read_source, seen_by, seen_flows, trained_on
from eddies.workflows.learned.training_data import load_frame, model_for, open_truths, training_data
from eddies.workflows.learned.training_phases import feature_range, take_all_steps, training_phases
from eddies.workflows.run_directory.fingerprints import stage_provenance

log = logging.getLogger("eddies")

# Wall seconds between two drawings of the learning curves.
DRAWING_SECONDS = 30.0


def run(scene: Scene, comm: Comm, directory: str | Path, stop: StopRequest | None = None) -> None:
    """Train the model of a scene and write model.h5: weights, learning history, a-priori tests and feature range.

    With [model] path the weights of another run are used, without training. A stopped training continues from its
    newest checkpoint.
    """
    directory, provenance = Path(directory), stage_provenance(scene, "train")
    own_file, product = directory / STAGES["dns"].file, directory / STAGES["train"].file
    definition, settings, device = ModelDefinition.of(scene), scene.training, prepare_torch(scene.device, comm)
    if scene.model.path is not None:
        source = read_source(scene.name, definition, comm)
        with open_truth(comm, own_file, device) as truth:
            take_weights(source, definition, scene.seen_in(directory), provenance, truth, product)
        return
    with open_truths(own_file, settings.truth_files, comm, device) as (truth, truths):
        data = training_data(definition, settings, truths)
        model, dtype = data[0].model, data[0].dtype
        for each in data:
            log.info("train: %d parameters; trains on frames up to %d and keeps the next %d for validation; the "
                     "training window ends at t = %.3g, the ground truth at t = %.3g",
                     sum(p.numel() for p in model.parameters()), each.learned, each.last - each.learned,
                     each.truth.times[each.last], each.truth.times[-1])
        own = next((each.model for each in data if each.truth is truth), None)
        # If the model is trained only on other ground truths, it has seen no part of this run's ground truth.
        last = last_seen(settings.window if own is not None else 0.0, len(truth.times))
        guard = Guard(comm, directory / STAGES["train"].checkpoints, provenance["fingerprint"], stop,
                      " of the training")
        history, cost, curves = {}, [], None
        phases = training_phases(data, directory / STAGES["train-kernel"].file)
        if not phases:
            log.info("train: no training, because the terms have no parameters or [training] has no steps")
        else:
            training, curves = Training(comm, model, phases), LearningCurves(comm, directory / "learning.png")
            take_all_steps(training, guard, "train", "training", "lower learning_rate here or in [training.horizons], "
                           "or shorten time_step there", curves)
            history, cost = {"history": Table(training.columns(), units={"seconds": "s"})}, training.cost
        tested = model_for(definition, truth, dtype, model) if own is None else own
        tables = history | evaluate(truth, tested, last, dtype)
        if model.networks:
            tables["feature_range"] = Table(vars(feature_range(data)), "input")
        description = definition.describe(truth.scales) | {"training": cost,
                                                           "coefficients": tested.learned_coefficients}
        of_named = {str(path): truth.reference.get("mach_turbulent")
                    for path, truth in zip(settings.truth_files, truths)}
        provenance |= {"mach_turbulent": truth.reference.get("mach_turbulent"),
                       "truths": {path: product_provenance(path).get("id") for path in of_named},
                       "mach_of_truths": of_named, "seen": on_first_rank(comm, lambda: seen_flows(scene, directory))}
    weights = {name: tensor.cpu().numpy() for name, tensor in model.state_dict().items()}
    save_weights(comm, product, "model", description, weights, provenance, tables)
    guard.checkpoints.remove()
    if curves is not None:  # only now, because an error in drawing must not lose the product
        curves.draw(training)
    errors = tables["a_priori"]
    beside = (f" (the exact filtered pressure gradient alone: {errors['pressure_gradient_error'][-1]:.3f})"
              if "pressure_gradient_error" in errors else "")
    since = ("end of the training window" if own is not None
             else "release of the tracers; trained on other ground truths")
    log.info("model: a-priori acceleration error %.3f%s, at the time %.3g after the %s",
             errors["acceleration_error"][-1], beside, errors["delay"][-1], since)


def take_weights(source: StoredWeights, definition: ModelDefinition, window: float, provenance: Mapping[str, Any],
                 truth: GroundTruth, product: Path) -> None:
    """Write model.h5 with the weights that [model] path names, without training; collective.

    Terms work in units of the flow (Eq. 4), so only the scales and the radius of interaction change to those of this
    flow. The tables and the cost of training are copied from `source`, but the a-priori tests are repeated on this
    flow. If `source` has tests on the flow on which it was trained, they are kept as `source_a_priori`. `window` is the
    share of this ground truth that the training window covers.
    """
    comm = truth.decomposition.comm
    model = trained_model(definition, source, truth.scales, comm).to(truth.device).forced(truth.forcing)
    dtype = next((parameter.dtype for parameter in model.parameters()), torch.float64)
    tables = evaluate(truth, model, last_seen(window, len(truth.times)), dtype)
    description = definition.describe(truth.scales) | {"coefficients": model.learned_coefficients}
    if "training" in source.description:
        description["training"] = source.description["training"]
    origin, own_errors = trained_on(source, definition.model.path)
    seen = on_first_rank(comm, lambda: seen_by(source.provenance, source.path.parent))
    provenance = {**provenance, "mach_turbulent": truth.reference.get("mach_turbulent"), "source": origin, "seen": seen}
    kept = source.tables | ({"source_a_priori": own_errors} if own_errors else {})
    save_weights(comm, product, "model", description, source.weights, provenance, kept | tables)
    errors, beside = tables["a_priori"], []
    if "pressure_gradient_error" in errors:
        beside.append(f"exact filtered pressure gradient {errors['pressure_gradient_error'][-1]:.3f}")
    beside.append(f"on the flow of its training {own_errors['acceleration_error'][-1]:.3f}" if own_errors else
                  f"trained on {', '.join(origin['truths'])}")
    log.info("model: weights of %s; acceleration error %.3f (%s)", source.path, errors["acceleration_error"][-1],
             "; ".join(beside))


class LearningCurves:
    """Draws the history of a training to a file on rank 0, now and then. A failure is logged once as a warning."""

    def __init__(self, comm: Comm, path: Path) -> None:
        self.comm, self.path, self._drawn, self._failed = comm, path, time.monotonic(), False

    def __call__(self, training: Training) -> None:
        """Draw if DRAWING_SECONDS have passed since the last drawing."""
        if time.monotonic() - self._drawn > DRAWING_SECONDS:
            self.draw(training)

    def draw(self, training: Training) -> None:
        """Draw now, on rank 0."""
        self._drawn = time.monotonic()
        if self.comm.rank > 0 or self._failed:
            return
        try:
            from eddies.report import figures  # matplotlib takes a while to start
            from eddies.report.learning import curves
            write_files({self.path: figures.png(curves({"": (training.columns(), figures.MODEL)}))})
        except (Exception, SystemExit) as error:  # from matplotlib, its settings or the disk: the training continues
            self._failed = True
            log.warning("train: cannot draw %s (%s: %s); the training continues without it", self.path,
                        type(error).__name__, error)


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
