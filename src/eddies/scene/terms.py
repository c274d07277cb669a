"""The settings and properties of each term, and the presets, which are named lists of terms.

A class of settings is a section of a scene: a frozen dataclass whose fields declare the keys of [model.NAME]. This
module does not need torch.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from eddies.errors import UserError
from eddies.scene import sections
from eddies.scene.integrators import Scheme
from eddies.scene.values import Section, boolean, choice, integer, integers, named, number, texts

READS = ("pairs", "resolved", "density")
GIVES = ("acceleration", "density", "density_rate", "shift_velocity")
#: The inputs of a network that gets pairs of particles, in units of the flow: the densities of both particles, and |x|,
#: |v| and x.v of their separation x and their relative velocity v.
INPUTS = ("density", "distance", "speed", "approach")
BASES = ("corrected", "paper", "unit")
# The ratio of the largest rate at which the noise of a particle relaxes to the rate that the key `relaxation` gives. A
# velocity relaxes to the estimate from its neighbours, and this estimate repeats the noise of the particle with the
# opposite sign. The ratio is therefore 3.6 to 4.0, both among random particles and in turbulence. It is doubled: other
# effects let noise grow too. In flows that are forced for twenty turnovers the noise grows somewhere, by a fifth to a
# third in a step, with rk2 and a ratio of 7. With 8 it does not; nor does it with corrected-verlet or rk3 and 7.
NOISE_AMONG_NEIGHBORS = 8.0


@dataclass(frozen=True, kw_only=True)
class StepUnits:
    """The quantities that limit the time step of a rollout.

    Parameters
    ----------
    radius : radius of interaction.
    filter_width : width of the Gaussian filter.
    sound_speed : speed of sound; None if the flow has no sound.
    velocity : rms of a component of the velocity; None if it is unknown.
    scheme : time stepping scheme.
    """

    radius: float
    filter_width: float
    sound_speed: float | None
    velocity: float | None
    scheme: Scheme


class TermError(UserError, ValueError):
    """A term cannot be made with its settings, or contradicts its declaration; the text names the term and a remedy."""


class TermBase:
    """Base class of eddies.Term. It serves to recognise the class of a term without importing torch."""

    Settings: type["TermSettings"]


@dataclass(frozen=True, kw_only=True)
class TermSettings(Section):
    """The keys of [model.NAME], and the properties of a term with these settings.

    Attributes
    ----------
    word : name of the term in scenes; empty for a user's class.
    reads : its inputs, any of "pairs" (neighbours within the radius of interaction, also for kriging), "resolved" (the
        velocity on a grid) and "density" (computed and stored by the rollout, needed in the ground truth). The term
        gets no other inputs.
    gives : its outputs, any of "acceleration", "density" (a contribution to it), "density_rate" and "shift_velocity".
    learns_through_horizons : whether only training through several steps of the simulation fits its parameters.
    viscous : whether it needs the viscosity of the fluid.
    damps_by : name of its parameter with damping rates by wavenumber, which a coarse grid can use; empty without one.
    follows_flow : whether rollouts shorten their steps to `longest_step` in the present flow.
    too_long : text of the error for a step beyond `longest_step`; it may contain {name}, {longest} and {integrator}.
    """

    word: ClassVar[str] = ""
    reads: ClassVar[tuple[str, ...]] = ()
    gives: ClassVar[tuple[str, ...]] = ("acceleration",)
    learns_through_horizons: ClassVar[bool] = False
    viscous: ClassVar[bool] = False
    damps_by: ClassVar[str] = ""
    follows_flow: ClassVar[bool] = False
    too_long: ClassVar[str] = ""

    def longest_step(self, units: StepUnits) -> float:
        """Return the longest step of a rollout that the term allows; infinite if there is no limit, or if the limit is
        unknown."""
        return math.inf

    @classmethod
    def section_name(cls) -> str:
        """Return the name of the class, because only the scene knows the name of the section."""
        return cls.__qualname__


@dataclass(frozen=True, kw_only=True)
class PairSum(TermSettings):
    """Settings of a term that is a sum over pairs: the weight of each pair, and the scaling of the sum."""

    window: str = choice("factor of a pair at the distance q, in radii of interaction; smooth: (1 - q^2)^2; none: 1, "
                         "so that rates jump when a neighbour enters or leaves", "smooth", "none",
                         default="smooth")
    scaling: str = choice("factor of the sum, from the expected number n of neighbours; number: 1/n; root: n^(-1/2)",
                          "number", "root", default="number")


@dataclass(frozen=True, kw_only=True)
class ForceSum(PairSum):
    """Settings of a term that is a sum of pair forces. The force of a pair has components along two directions."""

    basis: str = choice("directions of a pair's forces; paper: x and v of Eq. 4; unit: x/|x| and v/|v|; corrected: x "
                        "and v, with the inverse moment matrix as the scaling of the sum", *BASES,
                        default="corrected")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.basis == "corrected" and (self.window, self.scaling) != ("smooth", "number"):
            key = "window" if self.window != "smooth" else "scaling"
            raise self.problem(key, 'the moment matrix of basis = "corrected" replaces both window and scaling; set '
                               'basis = "paper" or "unit"')


@dataclass(frozen=True, kw_only=True)
class NetworkSettings(PairSum):
    """Settings of a term with a network, whose inputs are quantities of a pair that no rotation changes."""

    hidden: tuple[int, ...] = integers("widths of the network's layers", default=(16, 16), at_least=1)
    inputs: tuple[str, ...] = texts("inputs of the network", *INPUTS, default=INPUTS)
    network: str = named("class of the network", "dense", default="dense")

    @property
    def reads(self) -> tuple[str, ...]:  # type: ignore[override]
        """Pairs, and the density if it is an input of the network."""
        return ("pairs", "density") if "density" in self.inputs else ("pairs",)


@dataclass(frozen=True, kw_only=True)
class PairNetwork(ForceSum, NetworkSettings):
    """The learned force between pairs, Eqs. 3 and 4 of the paper."""

    word = "pairs"

    symmetry: str = choice("symmetry of a pair; antisymmetric: opposite forces, which conserve momentum; not with "
                           "basis corrected", "none", "antisymmetric", default="none")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.symmetry == "antisymmetric" and self.basis == "corrected":
            raise self.problem("symmetry", 'with basis = "corrected" the forces of a pair are not opposite, because '
                               'each particle has its own moment matrix; set basis = "paper", or symmetry = "none"')


@dataclass(frozen=True, kw_only=True)
class EddyViscosity(ForceSum):
    """Explicit eddy viscosity between pairs: the term Pi in Eq. 3 of the paper."""

    word = "eddy-viscosity"

    form: str = choice("pairs that it acts on; two-sided: all; monaghan: approaching; bounded: all, with tanh(x.v) "
                       "for x.v", "two-sided", "monaghan", "bounded", default="two-sided")
    reads = ("pairs",)


@dataclass(frozen=True, kw_only=True)
class DensityFlux(NetworkSettings):
    """The network that gives the rate of the density in Eq. 3 of the paper."""

    word = "density-flux"

    sign: bool = boolean("whether the sign of the density difference of the pair is a factor", default=False)

    gives = ("density_rate",)

    @property
    def reads(self) -> tuple[str, ...]:  # type: ignore[override]
        """Pairs; also the density if the network has it as an input or if the key `sign` is true."""
        return ("pairs", "density") if self.sign or "density" in self.inputs else ("pairs",)


@dataclass(frozen=True, kw_only=True)
class DensityDiffusion(PairSum):
    """Nonlinear diffusion of the density between pairs: the part of Pi in the density equation."""

    word = "density-diffusion"
    reads = ("pairs", "density")
    gives = ("density_rate",)


@dataclass(frozen=True, kw_only=True)
class Pressure(TermSettings):
    """The pressure of the resolved velocity, which gives a density and a force."""

    word = "pressure"
    reads = ("resolved",)
    gives = ("acceleration", "density")


@dataclass(frozen=True, kw_only=True)
class Stress(TermSettings):
    """The subfilter stress, and its pressure."""

    word = "stress"

    form: str = choice("form of the stress; deconvolution: from the velocity with the filter undone; gradient: the "
                       "leading term of its expansion in the filter width", "deconvolution", "gradient",
                       default="deconvolution")

    reads = ("resolved",)
    gives = ("acceleration", "density")


@dataclass(frozen=True, kw_only=True)
class Viscosity(TermSettings):
    """Molecular viscosity of the resolved velocity."""

    word, viscous = "viscosity", True
    reads = ("resolved",)


@dataclass(frozen=True, kw_only=True)
class Damping(TermSettings):
    """Spectral eddy damping of the resolved velocity, learned as a function of the wavenumber."""

    word = "damping"
    reads = ("resolved",)
    damps_by = "rates"


@dataclass(frozen=True, kw_only=True)
class Relaxation(TermSettings):
    """Relaxation of the particles' velocity to the resolved velocity."""

    word = "relaxation"
    reads = ("resolved",)


@dataclass(frozen=True, kw_only=True)
class Forcing(sections.Forcing, TermSettings):
    """Linear forcing of the large scales at a prescribed power of the unfiltered flow."""

    reads = ("resolved",)


@dataclass(frozen=True, kw_only=True)
class Continuity(TermSettings):
    """The continuity equation of smoothed particle hydrodynamics, integrated from the true density at the start."""

    word = "continuity"

    diffusion: float = number("initial delta of the density diffusion (Molteni & Colagrossi 2009); 0: no diffusion",
                              default=0.0, at_least=0)

    reads = ("pairs", "density")
    gives = ("density_rate",)

    @property
    def learns_through_horizons(self) -> bool:  # type: ignore[override]
        """Whether the term has a learned parameter: the coefficient of the diffusion, if `diffusion` is above 0."""
        return self.diffusion > 0


@dataclass(frozen=True, kw_only=True)
class WCSPH(TermSettings):
    """Pressure and artificial viscosity of weakly compressible smoothed particle hydrodynamics."""

    word = "wcsph"

    speed: float = number("initial sound speed of the pressure, in units of that of the flow", default=1.0, above=0)
    alpha: float = number("linear coefficient of the artificial viscosity", default=1.0, at_least=0)
    beta: float = number("quadratic coefficient of the artificial viscosity", default=2.0, at_least=0)
    exponent: float = number("gamma of the pressure c^2 rho_0 / gamma ((rho / rho_0)^gamma - 1)", default=1.0,
                             at_least=1)

    reads = ("pairs", "density")
    too_long = ('the term "{name}" has to resolve sound, with a step of at most {longest} unless it learns a lower '
                'sound speed; lower step, and use integrator = "verlet"')

    def longest_step(self, units: StepUnits) -> float:
        """Return 0.4 h / (c (1 + 0.6 alpha)) (Monaghan 1992), where h is half the radius of interaction and c the sound
        speed of the pressure; infinite if the flow has no sound."""
        if units.sound_speed is None:
            return math.inf
        return 0.4 * units.radius / 2 / (self.speed * units.sound_speed * (1 + 0.6 * self.alpha))


@dataclass(frozen=True, kw_only=True)
class TransportVelocity(TermSettings):
    """The shift of particles to sparser places by a constant background pressure (Adami, Hu & Adams 2013)."""

    word = "transport-velocity"
    reads = ("pairs", "density")
    gives = ("shift_velocity",)
    learns_through_horizons = True


@dataclass(frozen=True, kw_only=True)
class FilteredEquations(TermSettings):
    """The filtered equations of motion, whose derivatives kriging estimates from neighbours."""

    word, viscous = "filtered-equations", True

    sweeps: int = integer("iterations of the pressure among neighbours in each evaluation", default=8, at_least=1,
                          at_most=32)
    relaxation: float = number("rate, in units of 2 u'/d, at which a velocity relaxes to the estimate from its "
                               "neighbours", default=1.0, at_least=0)
    solenoidal: float = number("rate, in units of 2 u'/d, at which the pressure removes a divergence", default=3.5,
                               at_least=0)
    density: float = number("rate, in units of 2 u'/d, at which the density follows the pressure", default=3.5,
                            at_least=0)

    reads = ("pairs", "density")
    gives = ("acceleration", "density_rate")
    follows_flow = True
    too_long = ('with integrator = "{integrator}" and steps above about {longest} the noise of the particles, which '
                'the term "{name}" damps, would grow, so the particles will take steps of about {longest}; lower step '
                'to {longest}')

    def longest_step(self, units: StepUnits) -> float:
        """Return the longest step with which the scheme relaxes the noise of single particles without instability;
        infinite without relaxation, or if the rms of the velocity is unknown."""
        if not units.velocity or not self.relaxation:
            return math.inf
        rate = NOISE_AMONG_NEIGHBORS * self.relaxation * 2 * units.velocity / units.filter_width
        return units.scheme.decay / rate


#: The terms that a scene can name, by their word: all classes above that have a word.
TERMS: dict[str, type[TermSettings]] = {kind.word: kind for kind in list(globals().values())
                                        if isinstance(kind, type) and issubclass(kind, TermSettings) and kind.word}

# Coefficients of the artificial viscosity of "wcsph", near those that training finds. With the usual values, the
# friction is tens of times as large as the accelerations of turbulence.
LITTLE_FRICTION = {"alpha": 0.05, "beta": 1.5}

RESOLVED = ("pressure", "stress", "viscosity", "damping", "relaxation")


def _published(basis: str, hidden: tuple[int, ...]) -> dict[str, Mapping[str, Any]]:
    """Return the terms of Eq. 3 of the paper with their settings: the networks of force and density, and the term Pi in
    the equations of velocity and density.

    `hidden` holds the widths of the networks' layers. Settings that the paper does not state are those of its public
    code.
    """
    plain, network = {"window": "none", "scaling": "root"}, {"hidden": hidden}
    return {"pairs": {"basis": basis, **plain, **network},
            "eddy-viscosity": {"basis": basis, "form": "bounded", **plain},
            "density-flux": {"sign": True, **plain, **network}, "density-diffusion": plain}


#: The terms of each preset in their order, each with the settings that differ from its defaults.
PRESETS: dict[str, dict[str, Mapping[str, Any]]] = {
    "paper": _published("paper", (20, 20, 20, 20)),
    "paper-code": _published("unit", (20, 100, 20)),
    "resolved": dict.fromkeys(RESOLVED, {}),
    # The density follows from the pressure, whose force is already a term. So the density as an input of the network
    # adds nothing. It also doubles the cost, because the forces of a pair are then not opposite.
    "resolved + pairs": {**dict.fromkeys(RESOLVED, {}), "pairs": {"inputs": ("distance", "speed", "approach")}},
    "local": {"filtered-equations": {}, "eddy-viscosity": {}},
    "local + pairs": {"filtered-equations": {}, "eddy-viscosity": {}, "pairs": {"hidden": (20, 20, 20, 20)}},
    "wcsph": {"continuity": {}, "wcsph": LITTLE_FRICTION},
    "transport-velocity": {"continuity": {}, "wcsph": LITTLE_FRICTION, "transport-velocity": {}},
}
DEFAULT_PRESET = "paper"
