"""The particle model: a list of terms."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pkgutil import iter_modules
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.func import functional_call

from eddies.errors import UserError
from eddies.import_path import is_path, load, short_name
from eddies.parallel.reduction import any_rank
from eddies.particles import terms as built_in
from eddies.particles.context import Context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.rates import BY_PARTICLE, Rates, total
from eddies.particles.terms.forcing import Forcing
from eddies.particles.terms.term import PairTerm, Term
from eddies.scene.terms import TermError, TermSettings

#: The classes behind the words of [model] terms: those in the modules of eddies.particles.terms.
TERMS: dict[str, type[Term]] = {
    kind.Settings.word: kind
    for found in iter_modules(built_in.__path__)
    for kind in vars(import_module(f"{built_in.__name__}.{found.name}")).values()
    if isinstance(kind, type) and issubclass(kind, Term) and kind.Settings.word}
# The name of the forcing that is added to the terms of a model.
FORCING = "injection"


class LagrangianModel(nn.Module):
    """dv_i/dt, and d rho_i/dt where some term gives it, as the sum of terms.

    Parameters
    ----------
    terms : by name, in the order in which they are evaluated.
    flow : what they were made for, and the units of their rates.

    Terms that do not read the density come first; what they give of it is the density that the others see. What no term
    reads is not built, and the density is not computed where nobody reads it. Raises TermError where a term both reads
    the density and gives a part of it.
    """

    def __init__(self, terms: Mapping[str, Term], flow: FlowUnits) -> None:
        super().__init__()
        self.terms = cast(Mapping[str, Term], nn.ModuleDict(terms))  # which does not know the type of its modules
        self.flow = flow
        for name, term in self.terms.items():
            if "density" in term.reads and "density" in term.gives:
                raise TermError(f'term "{name}": reads the density and gives a part of it; it can do only one of both')

    def forced(self, settings: TermSettings | None) -> LagrangianModel:
        """The same terms, not copies of them, and the known forcing of a flow, if it has one."""
        if settings is None:
            return self
        return LagrangianModel({**self.terms, FORCING: Forcing(settings, self.flow)}, self.flow)

    def share_parameters(self, other: LagrangianModel) -> None:
        """Take the parameters of the same terms in the units of another flow for one's own: one set for both."""
        for name, parameter in other.named_parameters():
            module, _, own = name.rpartition(".")
            self.get_submodule(module).register_parameter(own, parameter)

    @property
    def reads(self) -> set[str]:
        """What some term reads."""
        return {name for term in self.terms.values() for name in term.reads}

    @property
    def gives(self) -> set[str]:
        """What some term contributes to."""
        return {name for term in self.terms.values() for name in term.gives}

    @property
    def reads_density(self) -> bool:
        """Whether the particles need a density."""
        return "density" in self.reads

    @property
    def density_is_given(self) -> bool:
        """Whether terms give the density that others read, instead of its rate."""
        return self.reads_density and "density" in self.gives

    @property
    def integrates_density(self) -> bool:
        """Whether the density is a state of its own, as terms give its rate."""
        return "density_rate" in self.gives

    @property
    def regresses_density(self) -> bool:
        """Whether a rate of density is learned from the rates of single moments."""
        return self.learns_density and not any(term.settings.learns_through_horizons for term in self._giving_rate)

    @property
    def learns_density(self) -> bool:
        """Whether a rate of density has something to learn."""
        return any(True for term in self._giving_rate for _ in term.parameters())

    @property
    def _giving_rate(self) -> list[Term]:
        return [term for term in self.terms.values() if "density_rate" in term.gives]

    @property
    def networks(self) -> list[PairTerm]:
        """The terms with a network of pairs, which can tell what it is given by `features`."""
        return [term for term in self.terms.values() if isinstance(term, PairTerm) and hasattr(term, "features")]

    @property
    def learned_coefficients(self) -> dict[str, list[dict[str, Any]]]:
        """What the terms have learned, by their names, ready for JSON; see `Coefficient`."""
        return {name: [asdict(each) for each in term.learned_coefficients] for name, term in self.terms.items()
                if term.learned_coefficients}

    def rates(self, context: Context, kept: Mapping[str, LinearRates] | None = None) -> Rates:
        """The sum of the terms: `acceleration` (k, 3), `density_rate` (k,) and what belongs to a shift if some term
        gives it, and the `density` (n,) itself, not its deviation, if terms give it; beside the acceleration the
        `force_modes` that are in it. Differentiable; collective.

        `kept` stands for terms at these very particles: see `linear_rates`.
        """
        kept, sums = kept or {}, []
        for stage in self._stages if self.density_is_given and context.density is None else [list(self.terms.items())]:
            anew = [term for name, term in stage if name not in kept]
            context.sum_pairs([term for term in anew if isinstance(term, PairTerm) and not _everywhere(term)])
            found = [kept[name].at(context.rows) if name in kept else _evaluated(term, context) for name, term in stage]
            sums.append(self._at_particles(total(found), context))
            deviation = sums[0].density
            if context.density is None and self.density_is_given and deviation is not None:
                context.density = context.flow.scales.density_mean + deviation
        result = total(sums)
        if result.acceleration is None:
            at_rest = torch.zeros_like(context.particles.velocity)
            result = replace(result, acceleration=at_rest if context.rows is None else at_rest[context.rows])
        return replace(result, density=context.density if self.density_is_given else None)

    @torch.no_grad()
    def linear_rates(self, context: Context) -> dict[str, LinearRates]:
        """What the single parameters do at given particles, by name of the terms that are linear in them and do not
        read a density that others give: a training that looks at these particles again and again keeps it;
        collective."""
        terms = self._stages[0] if self.density_is_given else self.terms.items()
        return {name: self._linear_rates(term, context) for name, term in terms if term.linear}

    @torch.no_grad()
    def require_linear(self, context: Context) -> None:
        """Check terms that declare themselves linear in their parameters at other parameters than what is kept was
        made with; raises TermError where one is not. Collective."""
        for name, kept in self.linear_rates(context).items():
            term, sizes = self.terms[name], [parameter.shape for parameter in kept.parameters]
            others = [torch.linspace(0.3, 1.9, shape.numel()).reshape(shape).to(parameter)
                      for shape, parameter in zip(sizes, kept.parameters)]
            named = dict(zip(dict(term.named_parameters()), others))
            direct = self._at_particles(_required(functional_call(term, named, (context,)), term), context)
            context.forget_sums(term)
            expected = replace(kept, parameters=others).at(None)
            # As a whole: what all but cancels at a particle is rounding there.
            wrong = [what for what in _GIVEN if getattr(direct, what) is not None and not (
                (getattr(expected, what) - getattr(direct, what)).norm() <= 1e-3 * getattr(direct, what).norm())]
            if any_rank(context.comm, bool(wrong)):
                raise TermError(f'term "{name}": declares itself linear in its parameters, and is not; remove its '
                                "linear = True")

    @property
    def _stages(self) -> list[list[tuple[str, Term]]]:
        """The terms that do not read the density, then those that do."""
        named = list(self.terms.items())
        return [[item for item in named if ("density" in item[1].reads) == reading] for reading in (False, True)]

    def _at_particles(self, rates: Rates, context: Context) -> Rates:
        """Rates of which what was given as modes is taken to the particles: the force less its mean over them, as it
        keeps their momentum. It would have none in continuous space, and has one where particles sample the grid
        unevenly."""
        pressure = rates.pressure_modes if self.density_is_given else None
        modes = [part for part in (rates.force_modes, None if pressure is None else pressure[None]) if part is not None]
        local = replace(rates, pressure_modes=None)
        if not modes:
            return local
        values = context.resolved.at_particles(torch.cat(modes)).to(context.particles.velocity)
        parts = [local]
        if rates.force_modes is not None:
            parts.append(Rates(acceleration=context.without_mean(values[:, :3])).at(context.rows))
        if pressure is not None:
            scales = context.flow.scales
            parts.append(Rates(density=values[:, -1] * (scales.density_mean / scales.required("sound_speed") ** 2)))
        return total(parts)

    def _linear_rates(self, term: Term, context: Context) -> LinearRates:
        parameters = dict(term.named_parameters())

        def at(values: Tensor) -> Rates:
            split = values.split([parameter.numel() for parameter in parameters.values()])
            named = {name: part.reshape(parameter.shape) for part, (name, parameter) in zip(split, parameters.items())}
            context.forget_sums(term)
            return self._at_particles(_required(functional_call(term, named, (context,)), term), context)

        count = sum(parameter.numel() for parameter in parameters.values())
        like = next(iter(parameters.values()), context.particles.position)
        origin = at(like.new_zeros(count))
        units = [at(unit) for unit in torch.eye(count, dtype=like.dtype, device=like.device)]
        context.forget_sums(term)
        return LinearRates(origin, {name: torch.stack([getattr(unit, name) - getattr(origin, name) for unit in units])
                                    for name in _GIVEN if units and getattr(origin, name) is not None},
                           list(parameters.values()))


_GIVEN = (*BY_PARTICLE, "density")


@dataclass(frozen=True)
class LinearRates:
    """Rates of a term at given particles as a function of its parameters: `origin` where they are zero, and by name
    what each of them adds, (parameters, n, ...)."""

    origin: Rates
    slopes: dict[str, Tensor]
    parameters: Sequence[Tensor]

    def at(self, rows: Tensor | None) -> Rates:
        """The rates, acceleration and rate of density of some rows (k,) of the particles, or of all; differentiable
        in the parameters."""
        values = {}
        for name in _GIVEN:
            value, slope = getattr(self.origin, name), self.slopes.get(name)
            if value is None:
                continue
            if rows is not None and name != "density":
                value, slope = value[rows], None if slope is None else slope[:, rows]
            if slope is not None:
                factors = torch.cat([parameter.flatten() for parameter in self.parameters]).to(slope)
                value = value + torch.tensordot(factors, slope, 1)
            values[name] = value
        return Rates(**values)


def _everywhere(term: Term) -> bool:
    """Whether a sum over pairs is for all particles, whichever are asked for: others see the density that it gives."""
    return isinstance(term, PairTerm) and "density" in term.gives


def _evaluated(term: Term, context: Context) -> Rates:
    """A term's rates, those of the particles that are asked for."""
    rates = _required(term(context.everywhere if _everywhere(term) else context), term)
    return rates if isinstance(term, PairTerm) else rates.at(context.rows)


def _required(found: object, term: Term) -> Rates:
    """What a term's forward returned; TermError unless these are Rates."""
    if not isinstance(found, Rates):
        raise TermError(f"{type(term).__name__}: forward returns a {type(found).__name__}; it must return Rates")
    if "density" in term.gives and found.density is None and found.pressure_modes is None:
        raise TermError(f'{type(term).__name__}: declares that it gives "density", and returns none; take it out of '
                        "`gives` of its settings, or return density or pressure_modes")
    return found


def build_model(settings: Mapping[str, TermSettings], paths: Iterable[str], flow: FlowUnits) -> LagrangianModel:
    """A model with initial parameters, in double precision.

    Parameters
    ----------
    settings : of each term, by the name that it goes by.
    paths : the word or import path of each.
    flow : what it is made for.

    Raises TermError where an import path does not lead to a Term, or it cannot be made; ImportPathError where it leads
    nowhere.
    """
    terms = {short_name(path): _build_term(path, settings[short_name(path)], flow) for path in paths}
    return LagrangianModel(terms, flow)


def _build_term(path: str, settings: TermSettings, flow: FlowUnits) -> Term:
    kind = load(path) if is_path(path) else TERMS[path]
    if not (isinstance(kind, type) and issubclass(kind, Term)):
        raise TermError(f'term "{path}": must be a class derived from eddies.Term')
    if not isinstance(settings, TermSettings):
        raise TermError(f'term "{path}": its Settings must be a frozen dataclass derived from eddies.TermSettings')
    try:
        return kind(settings, flow).double()
    except UserError as error:
        raise TermError(f'term "{path}": {error}') from error
    except Exception as error:  # of a class of the user's, anything
        raise TermError(f'term "{path}": cannot be made: {type(error).__name__}: {error}') from error
