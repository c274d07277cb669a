"""How sums over neighbours along x and along v become an acceleration, and how networks of pairs are made."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from eddies.import_path import is_path, load
from eddies.particles import moments
from eddies.particles.context import Context
from eddies.particles.dense_network import DenseNetwork
from eddies.particles.pairs import CompiledSum
from eddies.scene.terms import NetworkSettings, TermError


def along_separation(sums: Tensor, basis: str, context: Context) -> Tensor:
    """sum_j w f x (3, k): times the inverse moment matrix M_i^-1, M_i = sum_j w x x^T, in the basis "corrected", which
    makes derivatives of differences between irregular particles; over n in the basis "paper"."""
    if basis == "corrected":
        return moments.apply_symmetric(context.moments.inverse, sums)
    return sums / context.flow.neighbors


def along_velocity(sums: Tensor, basis: str, context: Context) -> Tensor:
    """sum_j w f v (3, k): over sum_j w in the basis "corrected", over n in the basis "paper"."""
    return sums / (context.moments.weight if basis == "corrected" else context.flow.neighbors)


def acceleration(scaled: Tensor, context: Context) -> Tensor:
    """A dimensionless acceleration (3, k) in the units of the flow, (k, 3)."""
    return (context.flow.scales.acceleration * scaled.T).to(context.particles.velocity.dtype)


def compiled_network(network: nn.Module, inputs: Sequence[str], outputs: int, symmetric: bool,
                     context: Context) -> CompiledSum | None:
    """What the compiled library is told of a term whose network has one or two `outputs`; None of a network that it
    does not know."""
    if type(network) is not DenseNetwork:
        return None
    layers = list(zip(network.weights, network.biases))
    told = [name in inputs for name in ("density", "distance", "speed", "approach")]
    return CompiledSum("pair-network", (outputs, symmetric, *told, *(len(bias) for _, bias in layers[:-1])),
                       torch.cat([parameter.flatten() for layer in layers for parameter in layer]),
                       (context.density_fluctuation,) if "density" in inputs else ())


def build_network(settings: NetworkSettings, outputs: int, seed: int) -> nn.Module:
    """The network of a term's settings: from features (inputs, m) of pairs to outputs (outputs, m).

    One of the user's own is made as Network(inputs, hidden, outputs, seed). Raises TermError if it cannot be, or is no
    torch.nn.Module.
    """
    inputs = len(settings.inputs) + ("density" in settings.inputs)
    if not is_path(settings.network):
        return DenseNetwork(inputs, settings.hidden, outputs, seed)
    kind = load(settings.network)
    if not (isinstance(kind, type) and issubclass(kind, nn.Module)):
        raise TermError(f'network = "{settings.network}": must be a class derived from torch.nn.Module')
    try:
        return kind(inputs, tuple(settings.hidden), outputs, seed)
    except TypeError as error:
        raise TermError(f'network = "{settings.network}": cannot be made with (inputs, hidden, outputs, seed): '
                        f"{error}") from error
