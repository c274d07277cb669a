"""Weights, directions and scaling of sums over neighbours, and the networks of pairs."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from eddies.import_path import is_path, load
from eddies.particles import moments
from eddies.particles.context import Context
from eddies.particles.dense_network import DenseNetwork
from eddies.particles.pairs import CompiledSum, ScaledPairs
from eddies.particles.periodic_box import safe_norm
from eddies.particles.rates import Rates
from eddies.scene.terms import ForceSum, NetworkSettings, PairSum, TermError

# Added to |x| and |v| in unit vectors, so that coincident particles have no direction.
SMALL = 1e-6


def window(pairs: ScaledPairs, settings: PairSum) -> Tensor:
    """Factor w (m,) of each pair: (1 - q^2)^2, or 1 within the radius of interaction."""
    return pairs.weight if settings.window == "smooth" else (pairs.weight > 0).to(pairs.weight)


def separation_direction(pairs: ScaledPairs, settings: ForceSum) -> Tensor:
    """b_1 (3, m): x, or x/|x| in the basis "unit"."""
    return pairs.x / (pairs.distance + SMALL) if settings.basis == "unit" else pairs.x


def velocity_direction(pairs: ScaledPairs, settings: ForceSum) -> Tensor:
    """b_2 (3, m): v, or v/|v| in the basis "unit"."""
    return pairs.v / (safe_norm(pairs.v, dim=0) + SMALL) if settings.basis == "unit" else pairs.v


def scaled(sums: Tensor, settings: PairSum, context: Context) -> Tensor:
    """Sums over neighbours divided by their expected number n, or by its square root."""
    neighbors = context.flow.neighbors
    return sums / (neighbors if settings.scaling == "number" else math.sqrt(neighbors))


def along_separation(sums: Tensor, settings: ForceSum, context: Context) -> Tensor:
    """Sums sum_j w f b_1 (3, k), scaled.

    In the basis "corrected" the factor is the inverse of M_i = sum_j w x x^T instead: differences between irregular
    particles then give a derivative.
    """
    if settings.basis == "corrected":
        return moments.apply_symmetric(context.moments.inverse, sums)
    return scaled(sums, settings, context)


def along_velocity(sums: Tensor, settings: ForceSum, context: Context) -> Tensor:
    """Sums sum_j w f b_2 (3, k), scaled; in the basis "corrected" divided by sum_j w."""
    return sums / context.moments.weight if settings.basis == "corrected" else scaled(sums, settings, context)


def density_rate(sums: Tensor, settings: PairSum, context: Context) -> Rates:
    """Dimensionless sums (1, k), scaled, as a density rate in the units of the flow."""
    rate = context.flow.scales.required("density_rate") * scaled(sums[0], settings, context)
    return Rates(density_rate=rate.to(context.particles.velocity.dtype))


def acceleration(scaled: Tensor, context: Context) -> Tensor:
    """Dimensionless acceleration (3, k) in the units of the flow, (k, 3)."""
    return (context.flow.scales.acceleration * scaled.T).to(context.particles.velocity.dtype)


def compiled_switches(settings: PairSum) -> tuple[float, float]:
    """Two numbers for the compiled library: 1 for unit vectors, else 0; and 1 for weighted pairs, else 0."""
    return getattr(settings, "basis", "") == "unit", settings.window == "smooth"


def compiled_network(network: nn.Module, settings: NetworkSettings, outputs: int, symmetric: bool, context: Context,
                     sign: bool = False) -> CompiledSum | None:
    """Sum of a term with a network for the compiled library; None for a network of a user's class.

    The network has one or two `outputs`. With `sign` the output is multiplied by the sign of the density difference.
    """
    if type(network) is not DenseNetwork:
        return None
    layers = list(zip(network.weights, network.biases))
    inputs = [name in settings.inputs for name in ("density", "distance", "speed", "approach")]
    return CompiledSum("pair-network", (outputs, symmetric, *inputs, *compiled_switches(settings), sign,
                                        *(len(bias) for _, bias in layers[:-1])),
                       torch.cat([parameter.flatten() for layer in layers for parameter in layer]),
                       (context.density_fluctuation,) if inputs[0] or sign else ())


def build_network(settings: NetworkSettings, outputs: int, seed: int) -> nn.Module:
    """Build the network of a term: from features (inputs, m) of pairs to outputs (outputs, m).

    A network of the user is made as Network(inputs, hidden, outputs, seed). Raises TermError if that fails, or if the
    class is no torch.nn.Module.
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
