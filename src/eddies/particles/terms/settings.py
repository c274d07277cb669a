"""What a scene can say of each term, and what each term reads: known without torch, so that a scene can be read and
checked where no particle is computed.

A class of settings is a frozen dataclass whose fields declare their keys as those of a scene's sections do.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from eddies.scene.values import KeyProblem, Section, choice, integer, integers, named, number, texts

READS = ("pairs", "resolved", "density")
GIVES = ("acceleration", "density", "density_rate", "shift_velocity")
#: What a network can be told of a pair, in units of the flow: the densities of both, |x|, |v| and x.v.
INPUTS = ("density", "distance", "speed", "approach")
BASES = ("corrected", "paper")


@dataclass(frozen=True, kw_only=True)
class TermSettings(Section):
    """The keys of [model.NAME], and what a term that is set so declares.

    Attributes
    ----------
    reads : of "pairs" (neighbours within the interaction radius, what they tell by kriging too), "resolved" (the
        velocity that a grid resolves of the particles'), "density" (so that it is computed, stored, and wanted of the
        ground truth). What no term reads is not built.
    gives : of "acceleration", "density" (a part of it), "density_rate" and "shift_velocity".
    learns_through_horizons : its parameters are trained through several steps of the simulation alone.
    numbers_per_pair : how many numbers it keeps of each pair while it is evaluated, for an estimate of the memory.
    """

    reads: ClassVar[tuple[str, ...]] = ()
    gives: ClassVar[tuple[str, ...]] = ("acceleration",)
    learns_through_horizons: ClassVar[bool] = False
    numbers_per_pair: ClassVar[int] = 0

    @classmethod
    def section_name(cls) -> str:
        """The class: a scene names the section by the term's place in its list, which is not known here."""
        return cls.__qualname__


@dataclass(frozen=True, kw_only=True)
class NetworkSettings(TermSettings):
    """A network of the invariants of a pair."""

    hidden: tuple[int, ...] = integers("widths of the network's layers", default=(16, 16), at_least=1)
    inputs: tuple[str, ...] = texts("what the network is told of a pair", *INPUTS, default=INPUTS)
    network: str = named("class of the network", "dense", default="dense")

    @property
    def reads(self) -> tuple[str, ...]:  # type: ignore[override]
        """Pairs, and with that input the density."""
        return ("pairs", "density") if "density" in self.inputs else ("pairs",)

    @property
    def numbers_per_pair(self) -> int:  # type: ignore[override]
        """The inputs, of which the density counts for both particles, what every layer gives, and a vector."""
        return len(self.inputs) + ("density" in self.inputs) + sum(self.hidden) + 3


@dataclass(frozen=True, kw_only=True)
class PairNetwork(NetworkSettings):
    """The learned pair force, Eqs. 3 and 4."""

    basis: str = choice("of the sum over pairs; corrected: times the inverse moment matrix", *BASES,
                        default="corrected")
    symmetry: str = choice("antisymmetric: pairs get opposite forces, which keep the momentum; with basis paper only",
                           "none", "antisymmetric", default="none")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.symmetry == "antisymmetric" and self.basis != "paper":
            raise KeyProblem(self.section_name(), "symmetry", f' = "{self.symmetry}": with basis = "{self.basis}" the '
                             "forces of a pair are not opposite, as each particle has a moment matrix of its own; set "
                             'basis = "paper", or symmetry = "none"')


@dataclass(frozen=True, kw_only=True)
class EddyViscosity(TermSettings):
    """Explicit eddy viscosity between pairs, the term Pi of Eq. 3."""

    form: str = choice("two-sided: of all pairs; monaghan: of approaching ones", "two-sided", "monaghan",
                       default="two-sided")
    basis: str = choice("of the sum over pairs, as of the pair network", *BASES, default="corrected")

    numbers_per_pair = 8
    reads = ("pairs",)


@dataclass(frozen=True, kw_only=True)
class DensityFlux(NetworkSettings):
    """The paper's rate of density: a learned flux between pairs."""

    gives = ("density_rate",)


@dataclass(frozen=True, kw_only=True)
class Pressure(TermSettings):
    """The pressure of the resolved velocity: the density that belongs to it, and its force."""

    reads = ("resolved",)
    gives = ("acceleration", "density")


@dataclass(frozen=True, kw_only=True)
class Stress(TermSettings):
    """The stress that the filter hides, and its pressure."""

    form: str = choice("deconvolution: of the velocity with the filter undone; gradient: the leading term of its "
                       "expansion in the filter width", "deconvolution", "gradient", default="deconvolution")

    reads = ("resolved",)
    gives = ("acceleration", "density")


@dataclass(frozen=True, kw_only=True)
class Viscosity(TermSettings):
    """Molecular viscosity of the resolved velocity."""

    reads = ("resolved",)


@dataclass(frozen=True, kw_only=True)
class Damping(TermSettings):
    """Spectral eddy damping of the resolved velocity, learned as a function of the wavenumber."""

    reads = ("resolved",)


@dataclass(frozen=True, kw_only=True)
class Relaxation(TermSettings):
    """Relaxation of the particles' velocity to what the grid resolves of it."""

    reads = ("resolved",)


@dataclass(frozen=True, kw_only=True)
class Forcing(TermSettings):
    """Linear forcing of the large scales at a prescribed power."""

    injection_rate: float = number("power injected per unit mass of the flow, before the filter", at_least=0)
    wavenumber: float = number("modes with 0 < |k| < this are forced", default=2.0, above=1)

    reads = ("resolved",)


@dataclass(frozen=True, kw_only=True)
class Continuity(TermSettings):
    """The continuity equation of smoothed particle hydrodynamics, from the true density on."""

    diffusion: float = number("delta of the density's diffusion (Molteni & Colagrossi 2009), at first; 0: without",
                              default=0.0, at_least=0)

    numbers_per_pair = 8
    reads = ("pairs", "density")
    gives = ("density_rate",)

    @property
    def learns_through_horizons(self) -> bool:  # type: ignore[override]
        """Where there is something to learn."""
        return self.diffusion > 0


@dataclass(frozen=True, kw_only=True)
class WCSPH(TermSettings):
    """Pressure and artificial viscosity of weakly compressible smoothed particle hydrodynamics."""

    alpha: float = number("linear coefficient of the artificial viscosity", default=1.0, at_least=0)
    beta: float = number("quadratic coefficient of the artificial viscosity", default=2.0, at_least=0)
    exponent: float = number("gamma of the pressure c^2 rho_0 / gamma ((rho / rho_0)^gamma - 1)", default=1.0,
                             at_least=1)

    numbers_per_pair = 8
    reads = ("pairs", "density")


@dataclass(frozen=True, kw_only=True)
class TransportVelocity(TermSettings):
    """Particles that a constant background pressure shifts to where there are fewer (Adami, Hu & Adams 2013)."""

    numbers_per_pair = 16
    reads = ("pairs", "density")
    gives = ("shift_velocity",)
    learns_through_horizons = True


@dataclass(frozen=True, kw_only=True)
class FilteredEquations(TermSettings):
    """The filtered equations of motion by derivatives that neighbours tell."""

    sweeps: int = integer("of the pressure from neighbour to neighbour, each time that forces are asked for", default=8,
                          at_least=1, at_most=32)
    relaxation: float = number("rate, over 2 u'/d, at which velocities relax to what neighbours tell", default=1.0,
                               at_least=0)
    solenoidal: float = number("rate, over 2 u'/d, at which the pressure takes out a divergence", default=3.5,
                               at_least=0)
    density: float = number("rate, over 2 u'/d, at which the density follows the pressure", default=3.5, at_least=0)

    reads = ("pairs", "density")
    gives = ("acceleration", "density_rate")
