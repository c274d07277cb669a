"""Build a model for a flow, and read models and smoothing kernels from files."""

import json
import logging
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.nn.parameter import is_lazy

from eddies.io.hdf5 import ProductError
from eddies.io.weights import StoredWeights, load_weights
from eddies.parallel.broadcast import first_complaint, on_first_rank
from eddies.parallel.communicator import Comm
from eddies.parallel.reduction import any_rank
from eddies.particles.flow_units import ReferenceScales
from eddies.particles.model import LagrangianModel, build_model
from eddies.particles.particle_field import WORDS, Form
from eddies.particles.particle_set import ParticleSet
from eddies.particles.smoothing_kernels import KernelNetwork
from eddies.scene.scene import SceneError
from eddies.scene.terms import TermError
from eddies.workflows.learned.source import ModelDefinition

log = logging.getLogger("eddies")


def initial_model(definition: ModelDefinition, scales: ReferenceScales, comm: Comm) -> LagrangianModel:
    """Make the model with initial parameters, equal on all ranks, for a flow of these scales; collective.

    Raises SceneError if a class of the user is not a term, cannot be instantiated, or differs between ranks.
    """
    try:
        model = build_model(definition.model.settings, definition.model.terms, definition.units(scales))
    except TermError as error:
        raise SceneError(f"[model] terms: {error}") from None
    take_from_first_rank(model, comm)
    return model


def take_from_first_rank(model: nn.Module, comm: Comm) -> None:
    """Copy parameters and buffers of rank 0 to all ranks; collective. If they differ between ranks, log a warning.

    Raises SceneError on all ranks if the tensors have other names, shapes, types, `requires_grad` or another order on
    some rank, or if a parameter has no shape yet. The order matters: gradients of ranks are summed in the order of the
    tensors.
    """
    tensors = [*model.named_parameters(), *model.named_buffers()]
    own = [[name, _form(tensor)] for name, tensor in tensors]
    first = on_first_rank(comm, lambda: own)
    wrong = next(((mine, other) for mine, other in zip_longest(own, first, fillvalue=["", "nothing"])
                  if mine != other), None)
    complaint = first_complaint(comm, wrong and (
        f"[model] terms: rank {comm.rank} has {' '.join(wrong[0]).strip()} where rank 0 has "
        f"{' '.join(wrong[1]).strip()}; register the same tensors in the same order on all ranks"))
    if complaint is not None:
        raise SceneError(complaint)
    shapeless = next((name for name, tensor in tensors if is_lazy(tensor)), None)
    if shapeless is not None:
        raise SceneError(f"[model] terms: {shapeless} has no shape, as in a lazy module; give the module its sizes")
    differing = []
    for name, tensor in tensors:
        values = tensor.detach().cpu().contiguous()
        given = values.clone()
        comm.Bcast(_bytes(given))
        if any_rank(comm, not np.array_equal(_bytes(given), _bytes(values))):
            differing.append(name)
            with torch.no_grad():
                tensor.copy_(given)
    if differing and comm.rank == 0:
        log.warning("model: initial values of %s differ between ranks; all ranks take those of rank 0. Draw random "
                    "numbers from a generator with the seed of the flow (flow.seed)", ", ".join(differing))


def _form(tensor: torch.Tensor) -> str:
    if is_lazy(tensor):
        return "without a shape"
    fixed = isinstance(tensor, nn.Parameter) and not tensor.requires_grad
    return f"{tensor.dtype} {list(tensor.shape)}" + (" that is not trained" if fixed else "")


def _bytes(tensor: torch.Tensor) -> np.ndarray:
    """Return the memory of a tensor as bytes, without a copy. This works also for types that numpy or MPI lack."""
    return tensor.reshape(-1).view(torch.uint8).numpy()


def trained_model(definition: ModelDefinition, stored: StoredWeights, scales: ReferenceScales,
                  comm: Comm) -> LagrangianModel:
    """Make the model with the stored weights, in their precision, for a flow of these scales; collective.

    Raises ProductError if the weights are those of another model.
    """
    path = stored.path
    for key, wanted, trained in definition.differences(stored.description):
        raise ProductError(f"{path}: was trained with {key} = {trained}, but the scene has {wanted}; run "
                           f"`eddies train` again, or set {key} = {trained}")
    model = initial_model(definition, scales, comm)
    expected = {name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}
    if expected != {name: tensor.shape for name, tensor in stored.weights.items()}:
        raise ProductError(f"{path}: its parameters do not fit the present terms; remove it and run `eddies train` "
                           "again")
    precision = next((tensor.dtype.name for tensor in stored.weights.values()), "float64")
    model.to(getattr(torch, precision))
    model.load_state_dict({name: torch.from_numpy(np.asarray(tensor)) for name, tensor in stored.weights.items()})
    return model


def particles_for(model: LagrangianModel, columns: dict[str, np.ndarray], device: torch.device) -> ParticleSet:
    """Make the particles on which a model starts from `columns` of true particles. They have a density only if the
    model integrates it."""
    particles = ParticleSet.from_numpy(columns, device)
    return particles if model.integrates_density else replace(particles, density=None)


def load_form(comm: Comm, path: str | Path, scales: ReferenceScales, device: torch.device | str = "cpu") -> Form:
    """Load the method of reconstruction (`Form`) that a kernel file names, with its kernel, for a flow of these scales.

    The kernel is a table in single precision. Raises ProductError if the file cannot be read, or if its kernel has
    another formula or form than those of this version.
    """
    stored = load_weights(comm, path, "kernel")
    description = stored.description
    network = KernelNetwork(description["support"], description["hidden"], description["cutoff"],
                            mean_volume=description.get("mean_volume"))
    formula = description.get("form", "NN g")
    if formula != network.formula:
        raise ProductError(f'{path}: was trained with the formula "{formula}", but this version uses '
                           f'"{network.formula}" for these settings: remove the file and run '
                           "`eddies train-kernel` again")
    name = description.get("reconstruction", "average")
    if name not in WORDS:
        raise ProductError(f'{path}: names the form "{name}", which this version does not have; set form = '
                           f'{" or ".join(map(json.dumps, WORDS))} in [kernel] of the scene and run '
                           "`eddies train-kernel SCENE`, which keeps the weights")
    network = network.to(dtype=torch.float32, device=device)
    network.load_state_dict({name: torch.from_numpy(tensor) for name, tensor in stored.weights.items()})
    with torch.no_grad():
        kernel = network.table()
    return Form(name, kernel, scales.filter_width)
