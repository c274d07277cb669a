"""The trained model of a file, with what is stored beside its weights."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from eddies.io.hdf5 import ProductError, open_product, read_table
from eddies.io.weights import load_weights
from eddies.particles.feature_range import FeatureRange
from eddies.particles.pair_forces import PairModel

log = logging.getLogger("eddies")


def load_model(comm, path: str | Path, device: torch.device) -> PairModel:
    """The trained model of a file; ProductError as `load_weights` and `model_from`."""
    return model_from(*load_weights(comm, path, "model"), path).to(device)


def model_from(description: Mapping[str, Any], tensors: Mapping[str, np.ndarray], path: str | Path) -> PairModel:
    """The model of a description with the weights of a file, in their precision.

    ProductError where the weights are not those of the described form as it is now.
    """
    model, precision = PairModel.from_description(description), next(iter(tensors.values())).dtype
    expected = {name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}
    if expected != {name: tensor.shape for name, tensor in tensors.items()}:
        raise ProductError(f'{path}: closure = "{model.closure}" has other weights now than when this was written; run '
                           "`eddies train` again")
    model.to(getattr(torch, precision.name))
    model.load_state_dict({name: torch.from_numpy(tensor) for name, tensor in tensors.items()})
    return model


def load_feature_range(comm, path: str | Path) -> FeatureRange | None:
    """The range of what the network of a file was given in training.

    None, and a line in the log, where the file is older than this table.
    """
    with open_product(comm, path, "model") as file:
        if "feature_range" in file:
            return FeatureRange(**read_table(file, "feature_range"))
    log.info("rollout: %s holds no feature_range, pairs outside the training range are not counted; `eddies train` "
             "stores it", path)
    return None
