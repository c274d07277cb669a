"""Neural networks for the force and the density rate of a pair, Eqs. 3 and 4.

The module also has the weights, directions and scaling that all sums over pairs use.
"""

import math

import torch
from torch import Tensor, nn

from eddies.import_path import is_path, load, users_code
from eddies.particles.context import Context, apply_symmetric
from eddies.particles.dense_network import DenseNetwork
from eddies.particles.flow_units import FlowUnits
from eddies.particles.pairs import CompiledSum, ScaledPairs
from eddies.particles.periodic_box import safe_norm
from eddies.particles.rates import Rates, described
from eddies.particles.terms.term import PairTerm
from eddies.scene import terms as declared
from eddies.scene.terms import ForceSum, NetworkSettings, PairSum, TermError

# This number is added to |x| and |v| in unit vectors, so that a zero vector divided by its length is zero.
SMALL = 1e-6


def window(pairs: ScaledPairs, settings: PairSum) -> Tensor:
    """Return the factor w (m,) of each pair: (1 - q^2)^2 with q = r/h, or 1, within the radius of interaction h."""
    return pairs.weight if settings.window == "smooth" else (pairs.weight > 0).to(pairs.weight)


def separation_direction(pairs: ScaledPairs, settings: ForceSum) -> Tensor:
    """Return b_1 (3, m), the direction from j to i of each pair: x, or x/|x| in the basis "unit"."""
    return pairs.x / (pairs.distance + SMALL) if settings.basis == "unit" else pairs.x


def scaled(sums: Tensor, settings: PairSum, context: Context) -> Tensor:
    """Return sums over neighbours divided by their expected number n, or by sqrt(n)."""
    neighbors = context.flow.neighbors
    return sums / (neighbors if settings.scaling == "number" else math.sqrt(neighbors))


def along_separation(sums: Tensor, settings: ForceSum, context: Context) -> Tensor:
    """Scale sums (3, k) over vectors b_1, or correct them for the irregular places of the neighbours.

    `sums` is sum_j w f b_1 with any factor f of a pair. In the basis "corrected" the result is M_i^-1 sum_j w f x with
    M_i = sum_j w x x^T. It estimates the gradient of a field if f is the difference of this field between i and j.
    """
    if settings.basis == "corrected":
        return apply_symmetric(context.moments.inverse, sums)
    return scaled(sums, settings, context)


def density_rate(sums: Tensor, settings: PairSum, context: Context) -> Rates:
    """Scale dimensionless sums (1, k), and convert them to density rates in the units of the flow."""
    rate = context.flow.scales.required("density_rate") * scaled(sums[0], settings, context)
    return Rates(density_rate=rate.to(context.particles.velocity.dtype))


def acceleration(scaled: Tensor, context: Context) -> Tensor:
    """Convert a dimensionless acceleration (3, k) to the units of the flow: (k, 3)."""
    return (context.flow.scales.acceleration * scaled.T).to(context.particles.velocity.dtype)


def compiled_switches(settings: PairSum) -> tuple[float, float]:
    """Return two numbers for the compiled library: 1 for the basis "unit", else 0; 1 for a smooth window, else 0."""
    return getattr(settings, "basis", "") == "unit", settings.window == "smooth"


def compiled_network(network: nn.Module, settings: NetworkSettings, outputs: int, symmetric: bool, context: Context,
                     sign: bool = False) -> CompiledSum | None:
    """Return a term's sum with a network, in the form of the compiled library; None for a network of a user's class.

    The network has one or two `outputs`. Its inputs are `ScaledPairs.invariants`, with `symmetric`. With `sign` the
    output is multiplied by the sign of the density difference.
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
    """Build the network of a term, which maps features (inputs, m) of pairs to outputs (outputs, m).

    A user's class is called with (inputs, hidden, outputs, seed). Raises TermError if the call fails, or if the class
    is not derived from torch.nn.Module.
    """
    inputs = len(settings.inputs) + ("density" in settings.inputs)
    if not is_path(settings.network):
        return DenseNetwork(inputs, settings.hidden, outputs, seed)
    kind = load(settings.network)
    if not (isinstance(kind, type) and issubclass(kind, nn.Module)):
        raise TermError(f'network = "{settings.network}": must be a class derived from torch.nn.Module')
    hint = f'; network = "{settings.network}" is called with (inputs, hidden, outputs, seed)'
    with users_code(kind, TermError, hint):
        return kind(inputs, tuple(settings.hidden), outputs, seed)


def outputs_of(network: nn.Module, features: Tensor, outputs: int) -> Tensor:
    """Return the outputs (outputs, m) of a network for features (inputs, m) of pairs. Raises TermError if a user's
    network fails or returns another shape."""
    with users_code(type(network), TermError):
        found = network(features)
    if not isinstance(found, Tensor) or found.shape != (outputs, features.shape[1]):
        raise TermError(f"{type(network).__qualname__}: returns {described(found)}; the network must return a tensor "
                        f"of shape ({outputs}, {features.shape[1]}): outputs, pairs")
    return found


class PairNetwork(PairTerm):
    """Forces between pairs of particles by a neural network, dv_i/dt = a_rms A_i with

        A_i = s (sum_j w NN_1 x + sum_j w NN_2 v)                            basis "paper"
        A_i = s (sum_j w NN_1 x/|x| + sum_j w NN_2 v/|v|)                    basis "unit"
        A_i = M_i^-1 sum_j w NN_1 x + sum_j w NN_2 v / sum_j w               basis "corrected"

    NN_1 and NN_2 are the two outputs of a network. Its inputs are the invariants of a pair, rho'_i, rho'_j, |x|, |v|
    and x.v, in the units of `ScaledPairs`. a_rms is the rms of a component of the acceleration, w the window, s the
    scaling, and M_i = sum_j w x x^T. With symmetry "antisymmetric" the first two invariants are rho'_i + rho'_j and
    (rho'_i - rho'_j)^2: the forces on the two particles are opposite and conserve the total momentum. They are also
    opposite if the densities are not among the inputs. In both cases each pair is evaluated once.
    """

    Settings = declared.PairNetwork
    settings: declared.PairNetwork
    parity = -torch.ones(6)

    def __init__(self, settings: declared.PairNetwork, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        self.network = build_network(settings, 2, flow.seed)
        self.mutual = settings.symmetry == "antisymmetric" or "density" not in settings.inputs
        self.needs_moments = settings.basis == "corrected"
        self.width = max(settings.hidden)

    def features(self, pairs: ScaledPairs) -> Tensor:
        """Inputs of the network, (features, m)."""
        return pairs.invariants(self.settings.inputs, self.mutual)

    def pair_values(self, pairs: ScaledPairs) -> Tensor:
        along_x, along_v = window(pairs, self.settings) * outputs_of(self.network, self.features(pairs), 2)
        v = pairs.v / (safe_norm(pairs.v) + SMALL) if self.settings.basis == "unit" else pairs.v
        return torch.cat([along_x * separation_direction(pairs, self.settings), along_v * v])

    def compiled(self, context: Context) -> CompiledSum | None:
        return compiled_network(self.network, self.settings, 2, self.mutual, context)

    def rates_of(self, sums: Tensor, context: Context) -> Rates:
        settings = self.settings
        along_v = (sums[3:] / context.moments.weight if settings.basis == "corrected"
                   else scaled(sums[3:], settings, context))
        return Rates(acceleration(along_separation(sums[:3], settings, context) + along_v, context))


class DensityFlux(PairTerm):
    """Density rate by a neural network: d rho_i/dt = r_rms s sum_j w NN_rho.

    With the setting `sign` each summand has the factor sign(rho_i - rho_j). r_rms is the rms of the density rate.
    NN_rho is a network of its own, whose inputs are the invariants of a pair. w, s and the invariants are as in
    PairNetwork. The paper does not state what replaces the directions x and v in the density equation; its public code
    uses this sign.
    """

    Settings = declared.DensityFlux
    settings: declared.DensityFlux

    def __init__(self, settings: declared.DensityFlux, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        # The seed differs from that of the force, and so do the initial weights.
        self.network = build_network(settings, 1, flow.seed + 1)
        self.mutual, self.width = "density" not in settings.inputs, max(settings.hidden)
        self.parity = torch.full((1,), -1.0 if settings.sign else 1.0)

    def features(self, pairs: ScaledPairs) -> Tensor:
        return pairs.invariants(self.settings.inputs, symmetric=False)

    def pair_values(self, pairs: ScaledPairs) -> Tensor:
        flux = window(pairs, self.settings) * outputs_of(self.network, self.features(pairs), 1)
        if not self.settings.sign:
            return flux
        own, other = pairs.densities
        return flux * torch.sign(own - other)

    def compiled(self, context: Context) -> CompiledSum | None:
        return compiled_network(self.network, self.settings, 1, False, context, self.settings.sign)

    def rates_of(self, sums: Tensor, context: Context) -> Rates:
        return density_rate(sums, self.settings, context)
