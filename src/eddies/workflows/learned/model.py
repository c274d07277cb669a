"""The model of a scene, as it is built, and model and smoothing kernel as they are read from files with what is stored
beside their weights."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn.parameter import is_lazy

from eddies.io.hdf5 import ProductError, open_product, read_table
from eddies.io.weights import load_weights
from eddies.parallel.broadcast import first_complaint, share_text
from eddies.parallel.communicator import Comm
from eddies.parallel.reduction import any_rank
from eddies.particles.feature_range import FeatureRange
from eddies.particles.flow_units import FlowUnits, ReferenceScales
from eddies.particles.forms import Form, form_of
from eddies.particles.model import LagrangianModel, build_model
from eddies.particles.smoothing_kernels import HermiteKernel, KernelNetwork
from eddies.scene.scene import Scene, SceneError
from eddies.scene.terms import TermError
from eddies.workflows.learned.source import differences

log = logging.getLogger("eddies")


def scene_model(scene: Scene, scales: ReferenceScales, comm: Comm) -> LagrangianModel:
    """The terms of a scene with initial parameters, the same on all ranks, for a flow of these scales; collective.

    Raises SceneError where a class of the user's is no term, or cannot be made, or differs between ranks.
    """
    # As many neighbours among particles of another mean distance than the scene's.
    radius = scene.interaction_radius * (scales.spacing / scene.tracers.spacing)
    flow = FlowUnits(scales, radius, scene.neighbors, scene.seed)
    try:
        model = build_model(scene.model.settings, scene.model.terms, flow)
    except TermError as error:
        raise SceneError(f"[model] terms: {error}") from None
    take_from_first_rank(model, comm)
    return model


def take_from_first_rank(model: nn.Module, comm: Comm) -> None:
    """Give parameters and buffers the values of rank 0 on all ranks, with a warning where they differed; collective.

    Raises SceneError, on all ranks, where a rank has others than rank 0, or of another shape or type, or fixed ones
    where rank 0 trains them, and where one has no shape before it is used.
    """
    own = {**dict(model.named_parameters()), **dict(model.named_buffers())}
    forms = {name: _form(tensor) for name, tensor in own.items()}
    first = json.loads(share_text(comm, json.dumps(forms)))
    wrong = next((name for name in {**first, **forms} if first.get(name) != forms.get(name)), None)
    complaint = first_complaint(comm, wrong and (
        f"[model] terms: {wrong} is {forms.get(wrong, 'missing')} on rank {comm.rank} and "
        f"{first.get(wrong, 'missing')} on rank 0; make it the same on all ranks"))
    if complaint is not None:
        raise SceneError(complaint)
    shapeless = next((name for name in first if is_lazy(own[name])), None)
    if shapeless is not None:
        raise SceneError(f"[model] terms: {shapeless} has no shape before it is used, as that of a lazy module; give "
                         "the module its sizes")
    differing = []
    for name in first:  # a rank may have registered them in another order
        values = own[name].detach().cpu().contiguous()
        given = values.clone()
        comm.Bcast(_bytes(given))
        if any_rank(comm, not np.array_equal(_bytes(given), _bytes(values))):
            differing.append(name)
            with torch.no_grad():
                own[name].copy_(given)
    if differing and comm.rank == 0:
        log.warning("model: %s: other values on other ranks; all take those of rank 0. Draw random numbers from a "
                    "generator with the seed of the flow (flow.seed)", ", ".join(differing))


def _form(tensor: torch.Tensor) -> str:
    if is_lazy(tensor):
        return "without a shape"
    fixed = isinstance(tensor, nn.Parameter) and not tensor.requires_grad
    return f"{tensor.dtype} {list(tensor.shape)}" + (" that is not trained" if fixed else "")


def _bytes(tensor: torch.Tensor) -> np.ndarray:
    """Those of a tensor, also of types that numpy or MPI do not know; no copy."""
    return tensor.reshape(-1).view(torch.uint8).numpy()


def load_model(scene: Scene, comm: Comm, path: str | Path, scales: ReferenceScales) -> LagrangianModel:
    """The scene's model with the weights of a file, for a flow of these scales; all ranks call it.

    Raises ProductError as `load_weights`, and where the file holds weights of another model.
    """
    return with_weights(scene, comm, *load_weights(comm, path, "model"), path, scales)


def with_weights(scene: Scene, comm: Comm, description: Mapping[str, Any], weights: Mapping[str, np.ndarray],
                 path: str | Path, scales: ReferenceScales) -> LagrangianModel:
    """The scene's model with weights that were stored with a description, in their precision; collective."""
    for key, wanted, trained in differences(scene, description):
        raise ProductError(f"{path}: was trained with {key} = {trained}, and the scene has {wanted}; run "
                           "`eddies train` again, or set the key to that")
    model = scene_model(scene, scales, comm)
    expected = {name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}
    if expected != {name: tensor.shape for name, tensor in weights.items()}:
        raise ProductError(f"{path}: its terms have other parameters now than when this was written; "
                           "remove it and run `eddies train` again")
    precision = next((tensor.dtype.name for tensor in weights.values()), "float64")
    model.to(getattr(torch, precision))
    model.load_state_dict({name: torch.from_numpy(np.asarray(tensor)) for name, tensor in weights.items()})
    return model


def load_feature_range(comm: Comm, path: str | Path) -> FeatureRange:
    """The range of what the networks of a file were given in training."""
    with open_product(comm, path, "model") as file:
        return FeatureRange(**read_table(file, "feature_range"))


def load_kernel(comm: Comm, path: str | Path, device: torch.device | str = "cpu") -> HermiteKernel:
    """The trained kernel as the table that is used at run time, in single precision.

    ProductError, besides the reasons of `load_weights`, where the weights are those of another formula of the kernel.
    """
    return _table_of(*load_weights(comm, path, "kernel"), path, device)


def load_form(comm: Comm, path: str | Path, scales: ReferenceScales) -> Form:
    """The form in which fields are reconstructed, as a kernel's file has it, with this kernel, in a flow of these
    scales. Errors as of `load_kernel`."""
    description, tensors = load_weights(comm, path, "kernel")
    return form_of(description.get("reconstruction", "average"), _table_of(description, tensors, path),
                   scales.filter_width, scales.spacing**3)


def _table_of(description: Mapping[str, Any], tensors: Mapping[str, np.ndarray], path: str | Path,
              device: torch.device | str = "cpu") -> HermiteKernel:
    network = KernelNetwork(description["support"], description["hidden"], description["cutoff"],
                            mean_volume=description.get("mean_volume"))
    formula = description.get("form", "NN g")
    if formula != network.formula:
        raise ProductError(f'{path}: form = "{formula}", and the kernel of these settings is now "{network.formula}": '
                           "remove it and run `eddies train-kernel` again")
    network = network.to(dtype=torch.float32, device=device)
    network.load_state_dict({name: torch.from_numpy(tensor) for name, tensor in tensors.items()})
    with torch.no_grad():
        return network.table()
