"""The learned pair force, Eqs. 3 and 4, and the learned rates of density."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from eddies.particles import moments
from eddies.particles.dense_network import DenseNetwork
from eddies.particles.eddy_viscosity import EddyViscosity
from eddies.particles.pairs import Pairs
from eddies.particles.periodic_box import safe_norm
from eddies.particles.reference_scales import ReferenceScales

BASES = ("paper", "corrected", "none")
CLOSURES = ("poisson", "poisson-force", "poisson-stress", "learned-density", "paper-density")
EDDY_VISCOSITIES = ("none", *EddyViscosity.FORMS)
SYMMETRIES = ("none", "antisymmetric")
# What is summed over neighbours, with the number of components; what changes sign where i and j are exchanged.
COMPONENTS = {"push": 3, "drag": 3, "weight": 1, "moment": 6, "strain": 6, "contrast": 1, "flux": 1}
ODD = ("push", "drag", "contrast")
# Added to moment matrices and sums of weights, as a fraction of their values for evenly spread neighbours:
# they stay invertible without neighbours or with coplanar ones, at a bias of a tenth of a percent elsewhere.
REGULARISATION = 1e-3
# The rates at which the closure damps the resolved velocity, to begin with: as a viscosity does, growing as k^2.
DAMPING = (torch.arange(1, 7) / 6) ** 2
# The first a and b of the learned density, of a trial on `hit`: with more divergence the scatter of the particles makes
# noise in the density (a = 0.07: five times the true rms), with less relaxation it grows until the rollout is lost.
DENSITY_FACTORS = 0.01, 0.4


class PairModel(nn.Module):
    """Rates of change of velocity and density as sums over neighbours, from one small network (Eqs. 3 and 4).

    Lengths are in units of the filter width d, velocities of v_rms, density fluctuations of rho_rms. With
    x = (x_i - x_j)/d, v = (v_i - v_j)/v_rms and rho' = (rho - rho_0)/rho_rms, the network turns the
    invariants (rho'_i, rho'_j, |x|, |v|, x.v) into NN_1, NN_2 and, if the closure learns one, a density flux
    NN_rho. Every pair is weighted by w = (1 - q^2)^2, q = r/h, so that all rates are smooth where a neighbour
    enters or leaves.

    dv_i/dt = a_rms A_i with
        A_i = 1/n (sum_j w (NN_1 + Pi) x + sum_j w NN_2 v)                          basis "paper"
        A_i = M_i^-1 sum_j w (NN_1 + Pi) x + sum_j w NN_2 v / sum_j w               basis "corrected"
        A_i = 0, and no network                                                     basis "none"
    where n is the expected number of neighbours and M_i = sum_j w x x^T. With symmetry "antisymmetric" the first two
    invariants are rho'_i + rho'_j and (rho'_i - rho'_j)^2: i and j get opposite forces, which keep the total momentum.

    Parameters
    ----------
    scales : measured scales of the flow.
    cutoff : h, the radius of interaction.
    neighbors : n, the expected number of particles within the cutoff.
    hidden : widths of the tanh layers.
    basis : "paper", "corrected"; or "none", with closure "poisson-stress" only: its force alone, whose factors are all
        that is learned.
    closure : "poisson", "poisson-force", "poisson-stress": no density rate, the density is given, and but in the first
        case a force with it, to which the pair sum is added (`resolved_factors`); "paper-density": r_rms/n sum_j w
        NN_rho, r_rms the rms of the density rate; "learned-density": -a rho_0 div v + b (c/h) (mean_j rho_j - rho_i)
        + the same flux, with the divergence from moment-corrected differences, the mean weighted by w, and a, b
        learned through steps of the simulation alone (see `ForceTrainer`): without these they stay where they start.
    eddy_viscosity : "none" (Pi = 0 and no parameters), "two-sided" or "monaghan".
    symmetry : "none", or "antisymmetric", with basis "paper" only: M_i^-1 differs from particle to particle.
    seed : of the initial weights.

    The module is in double precision until it is converted. Raises ValueError for an unknown choice, or two that do
    not go together.
    """

    reads = ("velocity", "density")

    def __init__(
        self,
        scales: ReferenceScales,
        cutoff: float,
        neighbors: float,
        hidden: Sequence[int] = (16, 16),
        basis: str = "corrected",
        closure: str = "poisson",
        eddy_viscosity: str = "none",
        symmetry: str = "none",
        seed: int = 1,
    ) -> None:
        super().__init__()
        _require("basis", basis, BASES)
        _require("closure", closure, CLOSURES)
        _require("eddy_viscosity", eddy_viscosity, EDDY_VISCOSITIES)
        _require("symmetry", symmetry, SYMMETRIES)
        if symmetry == "antisymmetric" and basis != "paper":
            raise ValueError(f'symmetry "antisymmetric" does not go with basis "{basis}", only with "paper"')
        self.scales, self.cutoff, self.neighbors, self.hidden = scales, cutoff, neighbors, tuple(hidden)
        self.basis, self.closure, self.eddy_viscosity, self.symmetry = basis, closure, eddy_viscosity, symmetry
        if basis == "none" and (closure != "poisson-stress" or eddy_viscosity != "none"):
            raise ValueError(f'basis "none" goes with closure "poisson-stress" and without eddy viscosity, not with '
                             f'"{closure}" and "{eddy_viscosity}"')
        if basis != "none":
            self.network = DenseNetwork(5, hidden, 3 if self.learns_density else 2, seed)
        if eddy_viscosity != "none":
            self.viscosity = EddyViscosity(eddy_viscosity)
        if closure == "poisson-stress":
            self.force_factors = nn.Parameter(torch.cat([torch.ones(1), DAMPING, torch.ones(1)]).double())
        if closure == "learned-density":
            # The factors a and b of the divergence and of the density's relaxation. There is no flux to begin with.
            self.density_factors = nn.Parameter(torch.tensor(DENSITY_FACTORS, dtype=torch.float64))
            with torch.no_grad():
                self.network.weights[-1][2], self.network.biases[-1][2] = 0.0, 0.0

    def resolved_factors(self) -> Tensor:
        """What the closure's force is made with, beside -grad p: A, D_1 ... D_6 and C of `PoissonClosure`, (8,).

        With "poisson-stress" they are learned, in units of values that they have in filtered turbulence, more or less:
        A = d^2/12 of the gradient model, v_rms/d for the rate D of damping, 2 v_rms/d for C. Otherwise they are zero.
        """
        if self.closure != "poisson-stress":
            return torch.zeros(len(DAMPING) + 2, dtype=torch.float64)
        length, rate = self.scales.length, self.scales.velocity / self.scales.length
        units = length**2 / 12, *len(DAMPING) * (rate,), 2 * rate
        return self.force_factors * self.force_factors.new_tensor(units)

    @property
    def pair_terms(self) -> list[PairModel]:
        """What `ParticleDynamics` is to sum over pairs: the model, or nothing with basis "none"."""
        return [] if self.basis == "none" else [self]

    @property
    def learns_density(self) -> bool:
        """Whether the density has a learned rate; otherwise the pressure on a grid gives it."""
        return self.closure.endswith("density")

    @property
    def mutual(self) -> bool:
        """Whether the effect of i on j follows from that of j on i, so that one evaluation of a pair gives both."""
        return self.symmetry == "antisymmetric"

    @property
    def parity(self) -> Tensor:
        """Of each component of `pair_values`: -1 if it changes its sign where i and j are exchanged, 1 otherwise."""
        return torch.tensor([-1.0 if name in ODD else 1.0 for name in self._summed for _ in range(COMPONENTS[name])])

    @property
    def width(self) -> int:
        """Most numbers that are held for a pair at once, for choosing how many pairs to take together."""
        return max(self.hidden)

    def forward(self, pairs: Pairs, columns: dict[str, Tensor]) -> dict[str, Tensor]:
        """Rates at the receivers of `pairs`.

        `columns` holds the local `velocity` (s, 3) and `density` (s,), owned then ghosts. Returns "velocity",
        the acceleration (count, 3), and "density", its rate (count,), if the closure learns one. The
        receivers' own rows are not their neighbours.
        """
        return self.rates(pairs.sum(self.pair_values(pairs, columns).T).T)

    def pair_values(self, pairs: Pairs, columns: dict[str, Tensor]) -> Tensor:
        """What is summed over neighbours: (components, m)."""
        x, v, own_density, other_density = self._dimensionless(pairs, columns)
        features = self._invariants(pairs, x, v, own_density, other_density)
        outputs = self.network(features)
        push, drag = outputs[0], outputs[1]
        if self.eddy_viscosity != "none":
            _, _, distance, _, approach = features
            push = push + self.viscosity(distance, approach)
        w = moments.weight(pairs.distance, self.cutoff)
        terms = [(w * push) * x, (w * drag) * v]
        if self._needs_moment:
            weighted_x = w * x
            terms += [w, *moments.products(weighted_x, x)]
        if self.closure == "learned-density":
            terms += [*moments.symmetric_products(weighted_x, v), w * (other_density - own_density)]
        if self.learns_density:
            terms.append(w * outputs[2])
        return torch.cat([torch.atleast_2d(term) for term in terms])

    def features(self, pairs: Pairs, columns: dict[str, Tensor]) -> Tensor:
        """What the network is given: the invariants (5, m) of the pairs."""
        return self._invariants(pairs, *self._dimensionless(pairs, columns))

    @property
    def _summed(self) -> list[str]:
        """Names of what is summed over neighbours, in the order of `pair_values`."""
        names = ["push", "drag"]
        names += ["weight", "moment"] if self._needs_moment else []
        names += ["strain", "contrast"] if self.closure == "learned-density" else []
        return names + (["flux"] if self.learns_density else [])

    def _invariants(self, pairs: Pairs, x: Tensor, v: Tensor, own: Tensor, other: Tensor) -> Tensor:
        """The invariants (5, m), from what `_dimensionless` gives."""
        densities = (own + other, (own - other).square()) if self.mutual else (own, other)
        return torch.stack([*densities, pairs.distance / self.scales.length, safe_norm(v, dim=0), (x * v).sum(0)])

    def _dimensionless(self, pairs: Pairs, columns: dict[str, Tensor]) -> tuple[Tensor, ...]:
        """x and v (3, m), rho'_i and rho'_j (m,) of the pairs."""
        scales, dtype = self.scales, pairs.displacement.dtype
        velocity, density = columns["velocity"], columns["density"]
        v = (pairs.at_receivers(velocity) - pairs.at_senders(velocity)).T.to(dtype) / scales.velocity
        own, other = (
            (column - scales.density_mean).to(dtype) / scales.density
            for column in (pairs.at_receivers(density), pairs.at_senders(density))
        )
        return pairs.displacement.T / scales.length, v, own, other

    @property
    def _needs_moment(self) -> bool:
        return self.basis == "corrected" or self.closure == "learned-density"

    def rates(self, sums: Tensor) -> dict[str, Tensor]:
        """Rates, as of a call, from the sums over neighbours (components, count)."""
        sums = dict(zip(self._summed, sums.split([COMPONENTS[name] for name in self._summed])))
        if self._needs_moment:
            inverse, total = self._inverse_moment(sums["moment"]), self._total_weight(sums["weight"])
        if self.basis == "corrected":
            acceleration = moments.apply_symmetric(inverse, sums["push"]) + sums["drag"] / total
        else:
            acceleration = (sums["push"] + sums["drag"]) / self.neighbors
        rates = {"velocity": self.scales.acceleration * acceleration.T}
        if self.learns_density:
            rates["density"] = self.scales.density_rate / self.neighbors * sums["flux"][0]
        if self.closure == "learned-density":
            divergence = moments.contract_symmetric(inverse, sums["strain"])
            contrast = (sums["contrast"] / total)[0]
            rates["density"] = rates["density"] + self._structured_rate(divergence, contrast)
        return rates

    def _structured_rate(self, divergence: Tensor, contrast: Tensor) -> Tensor:
        """-a rho_0 div v + b (c/h) (mean rho_j - rho_i) from dimensionless divergence and contrast."""
        scales = self.scales
        compression, relaxation = self.density_factors
        return (
            -compression * scales.density_mean * scales.velocity / scales.length * divergence
            + relaxation * scales.sound_speed / self.cutoff * scales.density * contrast
        )

    def _inverse_moment(self, moment: Tensor) -> Tensor:
        expected = moments.expected_moment(self.neighbors, self.cutoff / self.scales.length)
        diagonal = moment.new_tensor([1, 0, 0, 1, 0, 1]).unsqueeze(1)
        return moments.invert_symmetric(moment + REGULARISATION * expected * diagonal)

    def _total_weight(self, weight: Tensor) -> Tensor:
        return weight + REGULARISATION * moments.expected_weight(self.neighbors)

    def state_description(self) -> dict:
        """Everything but the weights, ready for JSON; `from_description` is the inverse."""
        return {
            "scales": self.scales.to_dict(),
            "support": self.cutoff,
            "neighbors": self.neighbors,
            "hidden": list(self.hidden),
            "basis": self.basis,
            "closure": self.closure,
            "eddy_viscosity": self.eddy_viscosity,
            "symmetry": self.symmetry,
        }

    @classmethod
    def from_description(cls, description: dict) -> PairModel:
        """A model with initial weights, to be given those saved with the description by `load_state_dict`.

        To use a model on another flow, replace the description's scales by that flow's.
        """
        settings = dict(description)
        scales = ReferenceScales.from_dict(settings.pop("scales"))
        return cls(scales, settings.pop("support"), **settings)


def _require(name: str, value: str, choices: Sequence[str]) -> None:
    if value not in choices:
        raise ValueError(f'{name} "{value}": one of {", ".join(choices)}')
