"""The particle model: a sum of terms."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pkgutil import iter_modules
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.func import functional_call

from eddies.errors import UserError
from eddies.import_path import is_path, load, short_name, users_code
from eddies.parallel.reduction import any_rank
from eddies.particles import terms as built_in
from eddies.particles.context import Context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.rates import BY_PARTICLE, Rates, described, total
from eddies.particles.terms.resolved_forces import Forcing
from eddies.particles.terms.term import PairTerm, Term
from eddies.scene.terms import TermError, TermSettings

#: The built-in terms, by the words that name them in a scene. Their classes are in modules of eddies.particles.terms.
TERMS: dict[str, type[Term]] = {
    kind.Settings.word: kind
    for module in iter_modules(built_in.__path__)
    for kind in vars(import_module(f"{built_in.__name__}.{module.name}")).values()
    if isinstance(kind, type) and issubclass(kind, Term) and kind.Settings.word}
# Name of the forcing among the terms of a model.
FORCING = "injection"
# By name of a rate: the word that `gives` must contain in the settings of a term that returns this rate. Modes of a
# pressure need no word; they have an effect only if `LagrangianModel.density_is_given`.
GIVES_OF = {"acceleration": "acceleration", "force_modes": "acceleration", "density": "density",
            "density_rate": "density_rate", "shift_velocity": "shift_velocity", "shift_acceleration": "shift_velocity"}
# Largest number of particles of a rank for which `check_terms` computes gradients with respect to parameters. Gradients
# through all pairs would take much memory.
CHECKED = 64
# The rates that LinearRates holds.
STORED = (*BY_PARTICLE, "density")


class LagrangianModel(nn.Module):
    """The rates of change of the particles i as sums of terms: dv_i/dt, and d rho_i/dt if some term gives it.

    Terms that do not read the density are evaluated first, because they may give the density that other terms read.
    Inputs that no term reads are not computed. Raises TermError if a term both reads and gives the density.

    Parameters
    ----------
    terms : the terms by name. Apart from the rule above, they are evaluated in this order.
    flow : scales of the flow that the terms were made for.
    """

    def __init__(self, terms: Mapping[str, Term], flow: FlowUnits) -> None:
        super().__init__()
        self.terms = cast(Mapping[str, Term], nn.ModuleDict(terms))  # nn.ModuleDict loses the type of its modules
        self.flow = flow
        for name, term in self.terms.items():
            if "density" in term.settings.reads and "density" in term.settings.gives:
                raise TermError(f'term "{name}": both reads and gives the density; it can do only one of the two')

    def forced(self, settings: TermSettings | None) -> LagrangianModel:
        """Return a model of the same terms (not copies) and a forcing with `settings`; this model if they are None."""
        if settings is None:
            return self
        return LagrangianModel({**self.terms, FORCING: Forcing(settings, self.flow)}, self.flow)

    def share_parameters(self, other: LagrangianModel) -> None:
        """Use the parameters of `other`, a model of the same terms for another flow: both then share one set."""
        for name, parameter in other.named_parameters():
            module, _, own = name.rpartition(".")
            self.get_submodule(module).register_parameter(own, parameter)

    @property
    def reads(self) -> set[str]:
        return {name for term in self.terms.values() for name in term.settings.reads}

    @property
    def gives(self) -> set[str]:
        return {name for term in self.terms.values() for name in term.settings.gives}

    @property
    def reads_density(self) -> bool:
        return "density" in self.reads

    @property
    def density_is_given(self) -> bool:
        """Whether some terms give the density itself, not its rate, and other terms read it."""
        return self.reads_density and "density" in self.gives

    @property
    def integrates_density(self) -> bool:
        """Whether the density is a state variable whose rate the terms give."""
        return "density_rate" in self.gives

    @property
    def learns_density(self) -> bool:
        """Whether a term that gives a density rate has learned parameters."""
        return any("density_rate" in term.settings.gives and list(term.parameters()) for term in self.terms.values())

    @property
    def regresses_density(self) -> bool:
        """Whether a density rate is learned from known rates at single moments alone, without runs of several steps."""
        through_horizons = any("density_rate" in term.settings.gives and term.settings.learns_through_horizons
                               for term in self.terms.values())
        return self.learns_density and not through_horizons

    @property
    def networks(self) -> list[PairTerm]:
        """The terms that evaluate a neural network for each pair. Their method `features` returns its inputs."""
        return [term for term in self.terms.values() if isinstance(term, PairTerm) and hasattr(term, "features")]

    @property
    def learned_coefficients(self) -> dict[str, list[dict[str, Any]]]:
        """Fields of each learned `Coefficient`, ready for JSON, by name of the term. Terms without any are left out."""
        found = {}
        for name, term in self.terms.items():
            with users_code(type(term), TermError):
                found[name] = [asdict(each) for each in term.learned_coefficients]
        return {name: coefficients for name, coefficients in found.items() if coefficients}

    def rates(self, context: Context, kept: Mapping[str, LinearRates] | None = None) -> Rates:
        """Return the rates of the k particles `context.rows`, the sums of all terms; differentiable, collective.

        The result always has an `acceleration` (k, 3), which includes the interpolated `force_modes` of the terms. It
        has `density_rate` (k,), `shift_velocity` (k, 3) and `shift_acceleration` (k, 3) if a term gives them. If
        `density_is_given`, it has the `density` (n,) of all n owned particles, not its deviation from the mean. `kept`
        holds results of `linear_rates` by name of the term; each replaces the evaluation of that term.
        """
        kept, sums = kept or {}, []
        for stage in self._stages if self.density_is_given and context.density is None else [list(self.terms.items())]:
            pair_terms = [term for name, term in stage if name not in kept and isinstance(term, PairTerm)]
            context.sum_pairs([term for term in pair_terms if not _everywhere(term)])
            rates = [kept[name].at(context.rows) if name in kept else _evaluated(term, context) for name, term in stage]
            sums.append(self._at_particles(total(rates), context))
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
        """Return the rates of each linear term as a function of its parameters, by name of the term; collective.

        Terms that read a density are left out if other terms give it. Training stores the result for each frame.
        """
        terms = self._stages[0] if self.density_is_given else self.terms.items()
        return {name: self._linear_rates(term, context) for name, term in terms if term.linear}

    def check_terms(self, context: Context) -> None:
        """Raise TermError if a term has a fault that the shapes of its rates do not show; collective.

        Such faults are rates that are not finite, a change of the particles in place, a parameter without an effect on
        the rates, and a term that declares itself linear and is not.
        """
        columns = list(context.particles.columns().values())
        before = [column.clone() for column in columns]
        few = context.of_rows(torch.arange(min(len(context.particles), CHECKED), device=columns[0].device))
        if self.density_is_given:
            with torch.no_grad():
                self.rates(context)
            few.density = context.density  # which some terms read
        for name, term in self.terms.items():
            for column, values in zip(columns, before):
                if not torch.equal(column, values):
                    column.copy_(values)
            context.forget_sums(term)
            with torch.no_grad():
                given = [value for value in vars(_evaluated(term, context)).values() if value is not None]
            if any_rank(context.comm, not all(map(torch.equal, columns, before))):
                raise TermError(f'term "{name}": changes the particles in place; work on a copy, such as '
                                "context.particles.velocity.clone()")
            if any_rank(context.comm, not all(bool(torch.isfinite(value).all()) for value in given)):
                raise TermError(f'term "{name}": its rates are not finite with the initial parameters; look for a '
                                "division by zero, a root or a logarithm")
            parameters = {key: parameter for key, parameter in term.named_parameters() if parameter.requires_grad}
            if not parameters:
                continue
            size = sum(value.abs().square().sum() for value in vars(_evaluated(term, few)).values()
                       if value is not None and value.requires_grad)
            reached: Sequence[Tensor | None] = [None] * len(parameters)
            if isinstance(size, Tensor):
                reached = torch.autograd.grad(size, list(parameters.values()), allow_unused=True)
            for parameter, gradient in zip(parameters, reached):
                if not any_rank(context.comm, gradient is not None):
                    raise TermError(f'term "{name}": its rates do not depend on the parameter {parameter}, so it '
                                    "cannot be learned; use it in forward without detach(), or make it a buffer")
        self.require_linear(context)

    @torch.no_grad()
    def require_linear(self, context: Context) -> None:
        """Raise TermError if a term declares itself linear and is not; collective.

        The function that `linear_rates` finds is compared with the term at other parameters."""
        for name, kept in self.linear_rates(context).items():
            term = self.terms[name]
            others = [torch.linspace(0.3, 1.9, parameter.numel()).reshape(parameter.shape).to(parameter)
                      for parameter in kept.parameters]
            direct = self._with_parameters(term, context, others)
            context.forget_sums(term)
            expected = replace(kept, parameters=others).at(None)
            # Norms over this rank's particles are compared: the rates of one particle may be rounding errors only.
            wrong = [rate for rate in STORED if getattr(direct, rate) is not None and not (
                (getattr(expected, rate) - getattr(direct, rate)).norm() <= 1e-3 * getattr(direct, rate).norm())]
            if any_rank(context.comm, bool(wrong)):
                raise TermError(f'term "{name}": declares linear = True, but is not linear in its parameters; remove '
                                "that line")

    @property
    def _stages(self) -> list[list[tuple[str, Term]]]:
        """Two lists of (name, term): the terms that do not read the density, and those that do."""
        stages: list[list[tuple[str, Term]]] = [[], []]
        for name, term in self.terms.items():
            stages["density" in term.settings.reads].append((name, term))
        return stages

    def _at_particles(self, rates: Rates, context: Context) -> Rates:
        """Return the rates with their modes interpolated to the particles.

        The mean over the box of the force is zero, so the momentum of the flow is conserved. That of the particles is
        not: particles do not sample the box evenly.
        """
        pressure = rates.pressure_modes if self.density_is_given else None
        modes = [part for part in (rates.force_modes, None if pressure is None else pressure[None]) if part is not None]
        parts = [replace(rates, pressure_modes=None)]
        if not modes:
            return parts[0]
        values = context.resolved.at_particles(torch.cat(modes)).to(context.particles.velocity)
        if rates.force_modes is not None:
            parts.append(Rates(acceleration=values[:, :3]).at(context.rows))
        if pressure is not None:
            scales = context.flow.scales
            parts.append(Rates(density=values[:, -1] * (scales.density_mean / scales.required("sound_speed") ** 2)))
        return total(parts)

    def _with_parameters(self, term: Term, context: Context, values: Sequence[Tensor]) -> Rates:
        """Return the rates of a term at the particles, with `values` in place of its parameters."""
        context.forget_sums(term)
        named = {name: value for (name, _), value in zip(term.named_parameters(), values)}
        rates = _checked(term, context, lambda: functional_call(term, named, (context,)))
        return self._at_particles(rates, context)

    def _linear_rates(self, term: Term, context: Context) -> LinearRates:
        parameters = list(term.parameters())
        count = sum(parameter.numel() for parameter in parameters)
        like = next(iter(parameters), context.particles.position)

        def at(values: Tensor) -> Rates:
            split = values.split([parameter.numel() for parameter in parameters])
            return self._with_parameters(term, context, [part.reshape(parameter.shape)
                                                         for part, parameter in zip(split, parameters)])

        origin = at(like.new_zeros(count))
        units = [at(unit) for unit in torch.eye(count, dtype=like.dtype, device=like.device)]
        context.forget_sums(term)
        slopes = {name: torch.stack([getattr(unit, name) - getattr(origin, name) for unit in units])
                  for name in STORED if units and getattr(origin, name) is not None}
        return LinearRates(origin, slopes, parameters)


@dataclass(frozen=True)
class LinearRates:
    """Rates of a term at given particles as a linear function of its parameters.

    Parameters
    ----------
    origin : rates with all parameters zero.
    slopes : by name of the rate, its derivative with respect to each parameter, (parameters, n, ...).
    parameters : the parameters of the term.
    """

    origin: Rates
    slopes: dict[str, Tensor]
    parameters: Sequence[Tensor]

    def at(self, rows: Tensor | None) -> Rates:
        """Return the rates of the particles `rows` (k,), of all if it is None; differentiable in the parameters.

        The density is always given for all particles.
        """
        values = {}
        for name in STORED:
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
    """Whether a term is evaluated at all owned particles: it is a sum over pairs and gives a density, which other terms
    may read."""
    return isinstance(term, PairTerm) and "density" in term.settings.gives


def _evaluated(term: Term, context: Context) -> Rates:
    where = context.everywhere if _everywhere(term) else context
    rates = _checked(term, where, lambda: term(where))
    return rates if isinstance(term, PairTerm) else rates.at(context.rows)


def _checked(term: Term, context: Context, evaluate: Callable[[], object]) -> Rates:
    """Return the rates of a term, the result of `evaluate`. Raises TermError, with the name of the term's class, if
    the term fails or does not return Rates of the declared kinds with one row for each particle."""
    name, gives = type(term).__name__, term.settings.gives
    with users_code(type(term), TermError):
        result = evaluate()
    if not isinstance(result, Rates):
        raise TermError(f"{name}: forward returns {described(result)}; it must return Rates")
    if "density" in gives and result.density is None and result.pressure_modes is None:
        raise TermError(f'{name}: declares that it gives "density", and returns none; remove it from `gives` of its '
                        "settings, or return density or pressure_modes")
    owned = len(context.particles)
    count = owned if context.rows is None or not isinstance(term, PairTerm) else len(context.rows)
    for rate, value in vars(result).items():
        if value is None:
            continue
        if (declared := GIVES_OF.get(rate)) not in (None, *gives):
            raise TermError(f'{name}: returns {rate}, but does not declare it; add "{declared}" to `gives` of its '
                            "settings")
        of_modes = rate.endswith("modes")
        if of_modes:
            shape = (*([3] if rate == "force_modes" else []), *context.resolved.grid.spectral.spectral_shape)
        else:
            shape = (owned if rate == "density" else count, *([] if rate.startswith("density") else [3]))
        if not isinstance(value, Tensor) or tuple(value.shape) != shape or value.is_complex() != of_modes:
            kind = "complex" if of_modes else "real"
            raise TermError(f"{name}: {rate} is {described(value)}; it must be a {kind} tensor of shape {shape}")
    return result


def build_model(settings: Mapping[str, TermSettings], paths: Iterable[str], flow: FlowUnits) -> LagrangianModel:
    """Make a model with initial parameters in double precision.

    `paths` are the words or import paths of its terms, and `settings` holds the settings of each by its short name.
    Raises ImportPathError if an import path leads to nothing. Raises TermError if it leads to something that is not a
    Term, or if the term cannot be made.
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
    except (Exception, SystemExit) as error:  # a user's class may raise anything
        raise TermError(f'term "{path}": cannot be made: {type(error).__name__}: {error}') from error
