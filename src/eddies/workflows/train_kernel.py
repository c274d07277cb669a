"""Train the smoothing kernel on filtered fields, with and without their gradients, and compare it with SPH kernels."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from eddies.analysis.lagrangian import evenly
from eddies.io.checkpoint import Guard
from eddies.io.hdf5 import Table
from eddies.io.weights import load_weights, save_weights
from eddies.learning.kernel_training import KernelSample, KernelTrainer
from eddies.learning.training import Phase, Training
from eddies.parallel.communicator import Comm
from eddies.parallel.migration import migrate
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.parallel.stop import StopRequest
from eddies.particles.devices import prepare_torch
from eddies.particles.flow_units import ReferenceScales
from eddies.particles.particle_field import Form, ParticleField
from eddies.particles.smoothing_kernels import CubicSpline, KernelNetwork, SmoothingKernel, WendlandC2, integral
from eddies.pipeline import STAGES
from eddies.scene.scene import Kernel, Scene
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.workflows.ground_truth.frame_counts import KERNEL_FIELDS
from eddies.workflows.ground_truth.truth import GroundTruth, open_truth
from eddies.workflows.learned.training_phases import take_all_steps
from eddies.workflows.run_directory.fingerprints import stage_provenance

log = logging.getLogger("eddies")

# The losses that are stored for each step.
LOSSES = "loss", "velocity", "gradient", "normalization"


def run(scene: Scene, comm: Comm, directory: str | Path, stop: StopRequest | None = None) -> None:
    """Train the kernel of a scene on fields of the training window and write kernel.h5.

    A second kernel is trained without the gradient loss (Fig. 1). Errors are measured on the last field of the ground
    truth. A stopped training continues from its newest checkpoint.
    """
    prepare_torch("cpu", comm)
    settings, directory, provenance = scene.kernel, Path(directory), stage_provenance(scene, "train-kernel")
    support = scene.tracers.radius_of(settings.neighbors)
    with open_truth(comm, directory / STAGES["dns"].file, planes=scene.tracers.cells) as truth:
        seen = np.flatnonzero(truth.fields.times <= scene.window * truth.times[-1])
        chosen = evenly(len(seen), KERNEL_FIELDS)
        samples = [load_sample(truth, index, support) for index in chosen]
        unseen, scales = load_sample(truth, len(truth.fields.times) - 1, support), truth.scales
    guard = Guard(comm, directory / STAGES["train-kernel"].checkpoints, provenance["fingerprint"], stop,
                  " of the training")
    mean_volume = None if settings.positive else scene.tracers.spacing**3
    training = training_of(settings, support, mean_volume, scene.seed, samples)
    take_all_steps(training, guard, "kernel", "kernel", "lower learning_rate")
    networks, history = training.model, losses_of(training)
    with torch.no_grad():
        kernels = {name: network.table() for name, network in networks.items()}
        kernels |= {"cubic_spline": CubicSpline(support), "wendland": WendlandC2(support)}
        errors, slices = compare(kernels, unseen)
        errors |= errors_of_kriging(kernels["learned"], unseen, scales)
    tables = {"kernels": shapes(kernels, support), "history": history, "errors": errors,
              "slices": Table(slices, "y x", {name: "1/T" if "gradient" in name else "L/T" for name in slices})}
    description = {"form": networks["learned"].formula, "support": support, "neighbors": settings.neighbors,
                   "hidden": list(settings.hidden), "cutoff": settings.cutoff,
                   "mean_volume": networks["learned"].mean_volume, "reconstruction": settings.form}
    weights = {name: tensor.numpy() for name, tensor in networks["learned"].state_dict().items()}
    save_weights(comm, directory / STAGES["train-kernel"].file, "kernel", description, weights,
                 provenance, tables)
    guard.checkpoints.remove()
    log.info("kernel: errors of the kernel average: velocity %.3f (with a cubic spline %.3f), gradient %.3f "
             "(with a cubic spline %.3f)",
             errors["velocity_error_learned"], errors["velocity_error_cubic_spline"],
             errors["gradient_error_learned"], errors["gradient_error_cubic_spline"])
    if settings.form == "kriging":
        log.info("kernel: errors of kriging: velocity %.3f, gradient %.3f", errors["velocity_error_kriging"],
                 errors["gradient_error_kriging"])


def keep_form(comm: Comm, path: Path, form: str | None, provenance: Mapping[str, Any]) -> None:
    """Write the name `form` of a method of reconstruction into the file of a trained kernel, if the file names another
    one; all ranks call it.

    Weights, tables and the id of the file do not change.
    """
    stored = load_weights(comm, path, "kernel")
    if stored.description.get("reconstruction", "average") != form:
        origin = {**provenance, "id": stored.provenance.get("id")}
        save_weights(comm, path, "kernel", {**stored.description, "reconstruction": form}, stored.weights, origin,
                     stored.tables)
        log.info('train-kernel: %s now has form = "%s"', path, form)


def load_sample(truth: GroundTruth, index: int, support: float) -> KernelSample:
    """Load the filtered field with this index, its exact gradient, and the particles at its time."""
    slab = truth.decomposition
    velocity = truth.planes(truth.fields, index, "velocity", slab)
    grid = SpectralGrid(slab, cutoff=(slab.planes - 1) // 2)
    derivatives = np.stack([grid.backward(grid.gradient(component)) for component in grid.forward(velocity)])
    columns = migrate(slab, truth.block(truth.field_frames[index], ("position", "velocity")))
    by_point = [torch.from_numpy(np.ascontiguousarray(np.moveaxis(values.reshape(*values.shape[:-3], -1), -1, 0)))
                for values in (velocity, derivatives)]
    position, own_velocity = (torch.from_numpy(columns[name]) for name in ("position", "velocity"))
    return KernelSample(ParticleField(slab, support, position, own_velocity), *by_point)


def training_of(settings: Kernel, support: float, mean_volume: float | None, seed: int,
                samples: list[KernelSample]) -> Training:
    """Return the training of two kernels: one with the gradient loss, then one without it.

    `mean_volume` is the mean volume of a particle if the kernels may be negative, and None if they are positive.
    """
    dtype, rates = samples[0].particles.dtype, (settings.learning_rate, settings.final_learning_rate)
    networks, phases = nn.ModuleDict(), []
    for name, gradient_weight in (("learned", settings.gradient_weight), ("learned_no_gradient", 0.0)):
        networks[name] = KernelNetwork(support, settings.hidden, settings.cutoff, seed, mean_volume).to(dtype)
        trainer = KernelTrainer(networks[name], samples, gradient_weight, settings.normalization_weight,
                                settings.points, seed)
        phases.append(Phase(name, np.ones(settings.steps), rates, trainer.step))
    return Training(samples[0].decomposition.comm, networks, phases)


def losses_of(training: Training) -> dict[str, np.ndarray]:
    """Return a table with the column `step` and, for each loss and each phase, the column `LOSS_PHASE`, such as
    `gradient_learned`."""
    columns = training.columns()
    table = {"step": np.arange(training.phases[0].steps)}
    for number, phase in enumerate(training.phases):
        own = {name: columns[name][columns["phase"] == number] for name in LOSSES if name in columns}
        table |= {f"{name}_{phase.name}": values for name, values in own.items() if not np.isnan(values).all()}
    return table


def shapes(kernels: dict[str, SmoothingKernel], support: float) -> dict[str, np.ndarray]:
    """Return the column `r_over_h` and, for each kernel NAME of support h, `value_NAME` = W h^3 and `derivative_NAME` =
    dW/dr h^4."""
    r = torch.linspace(0, support, 201)
    table = {"r_over_h": (r / support).numpy()}
    for name, kernel in kernels.items():
        table[f"value_{name}"] = kernel.value(r).numpy() * support**3
        table[f"derivative_{name}"] = kernel.derivative(r).numpy() * support**4
    return table


def compare(kernels: dict[str, SmoothingKernel],
            sample: KernelSample) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """Return the errors and the integral of each kernel, and u_x and du_x/dx in the plane z = pi; collective."""
    errors, slices = {}, {}
    slab = sample.decomposition
    slices["truth_velocity"] = _middle_plane(slab, sample.field[:, 0])
    slices["truth_gradient"] = _middle_plane(slab, sample.gradient[:, 0, 0])
    for name, kernel in kernels.items():
        velocity, derivative = sample.particles.averaged(kernel, sample.particles.points)
        errors[f"velocity_error_{name}"], errors[f"gradient_error_{name}"] = sample.errors_of(velocity, derivative)
        errors[f"integral_{name}"] = float(integral(kernel))
        slices[f"velocity_{name}"] = _middle_plane(slab, velocity[:, 0])
        slices[f"gradient_{name}"] = _middle_plane(slab, derivative[:, 0, 0])
    return errors, slices


def errors_of_kriging(kernel: SmoothingKernel, sample: KernelSample, scales: ReferenceScales) -> dict[str, float]:
    """Return the errors of kriging on a field; empty for a kernel that may be negative. Collective."""
    if kernel.mean_volume is not None:
        return {}
    form = Form("kriging", kernel, scales.filter_width)
    velocity, gradient = sample.errors_of(*form.at(sample.particles, sample.particles.points))
    return {"velocity_error_kriging": velocity, "gradient_error_kriging": gradient}


def _middle_plane(slab: SlabDecomposition, values: torch.Tensor) -> np.ndarray:
    """Return the plane z = pi, [y, x], of a scalar. `values` (m,) are those at the grid points of this rank; the result
    is the same on all ranks."""
    n, middle = slab.planes, slab.planes // 2
    plane = np.zeros((n, n))
    if slab.start <= middle < slab.stop:
        plane[:] = values.reshape(slab.count, n, n)[middle - slab.start]
    return global_sum(slab.comm, plane)
