"""How fast the ranks at hand evaluate a scene's own model: seconds of each part for what it works on, from evaluations
with few particles.

Each rank does so by itself, all at once: what a rank and its threads can do while the others work too. Nothing is sent.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch

from eddies.parallel.broadcast import on_all_ranks
from eddies.parallel.communicator import Comm
from eddies.parallel.reduction import global_max
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.context import PAIR_VALUES_TOGETHER, Context
from eddies.particles.devices import prepare_torch
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.flow_units import FlowUnits, ReferenceScales
from eddies.particles.fourier_grid import Points
from eddies.particles.model import LagrangianModel, build_model
from eddies.particles.neighborhood import at_home
from eddies.particles.particle_set import ParticleSet
from eddies.particles.terms.term import PairTerm
from eddies.scene.scene import BOX_LENGTH, Scene
from eddies.scene.terms import Forcing
from eddies.spectral.spectral_grid import SYMMETRIC
from eddies.workflows.foreseen.estimates import expected_turbulence
from eddies.workflows.foreseen.particle_work import VECTOR, particle_work

LEAST_SIDE = 12              # particles a side; as many again show what grows with their number, and what does not
ITERATIONS = 2
REPEATS = 4
#: What an evaluation is made of. The loops of THREADED are shared by the threads of a rank.
PARTS = "pairs", "splines", "transforms", "modes", "formulas", "settling"
THREADED = "pairs", "splines", "transforms", "modes"
SHARED = "splines", "transforms"  # parts that the iterations call, forth and back, three components each, and others
BLOCK_COPIES = 3             # of what a term keeps of a pair while it is evaluated


class ProbeError(RuntimeError):
    """The scene's model cannot be evaluated among few particles."""


@dataclass(frozen=True)
class Rate:
    """Seconds of a part: `call` for each time that it is asked for, and core seconds `unit` for each pair, particle,
    grid point or mode."""

    call: float
    unit: float


@dataclass(frozen=True)
class ParticleSpeed:
    """The speed of the ranks at hand, by part, and what the terms ask for.

    Parameters
    ----------
    rates : by part.
    calls, components : of transforms and splines in an evaluation, those of the iterations left out.
    ghost_columns : bytes of a ghost particle in each column that the evaluations at one place send.
    listed : whether some term's pairs are listed. block_bytes : what terms keep of the pairs that are taken together.
    kriging : whether some term asks for what neighbours tell.
    """

    rates: dict[str, Rate]
    calls: dict[str, float]
    components: dict[str, float]
    ghost_columns: tuple[int, ...]
    listed: bool = False
    block_bytes: float = 0.0
    kriging: bool = False


class Watch:
    """Seconds, calls and components of each part; what a part makes of another counts for the other alone."""

    def __init__(self) -> None:
        self._open, self._last = ["formulas"], time.perf_counter()
        self.reset()

    def reset(self) -> None:
        """Begin anew."""
        self.seconds: dict[str, float] = Counter()
        self.calls: dict[str, float] = Counter()
        self.components: dict[str, float] = Counter()
        self._last = time.perf_counter()

    def switch(self) -> None:
        """Book the time since the last switch on the part that is open."""
        now = time.perf_counter()
        self.seconds[self._open[-1]] += now - self._last
        self._last = now

    def on(self, thing: object, name: str, part: str, components: Callable[..., int] | None = None,
           calls: int = 1) -> None:
        """Let calls of this thing's method count for a part, each as so many calls with their components, or without
        where they belong to another call."""
        method = getattr(thing, name)

        def watched(*arguments, **named):
            self.switch()
            self._open.append(part)
            try:
                result = method(*arguments, **named)
            finally:
                self.switch()
                self._open.pop()
            if components is not None:
                self.calls[part] += calls
                self.components[part] += components(*arguments)
            return result

        setattr(thing, name, watched)


class Probe:
    """A model among few particles of one rank, watched."""

    def __init__(self, scene: Scene, alone: Comm, side: int) -> None:
        cells = 2 * round(0.875 * side)
        self.watch = Watch()
        model, dtype = probed_model(scene, side), getattr(torch, scene.simulation.precision)
        self.slab = SlabDecomposition(alone, BOX_LENGTH, cells)
        self.dynamics = ParticleDynamics(self.slab, model.to(dtype), scene.simulation.skin * model.flow.cutoff, dtype)
        self.work = replace(particle_work(scene), particles=side**3, cells=cells)
        if self.dynamics.resolution is not None:
            self.work = replace(self.work, wavenumber=self.dynamics.resolution.grid.resolved)
        self.particles = self._particles()
        self.columns: list[int] = []
        self._watch()

    def _particles(self) -> ParticleSet:
        """At random, in a flow of one wave, in the order in which they settle."""
        position = np.random.default_rng(1).uniform(0, BOX_LENGTH, (self.work.particles, 3))
        columns = {"id": np.arange(len(position)), "position": position, "velocity": np.sin(position[:, [1, 2, 0]])}
        if self.dynamics.model.integrates_density:
            columns["density"] = np.ones(len(position))
        tensors = {name: torch.from_numpy(column) for name, column in columns.items()}
        return ParticleSet(**at_home(self.slab, tensors, self.reach))

    @property
    def reach(self) -> float:
        """Side of the cells in whose order particles settle."""
        return self.dynamics.model.flow.cutoff if self.dynamics.neighborhood else self.slab.spacing

    def _watch(self) -> None:
        watch, dynamics = self.watch, self.dynamics
        make_context = dynamics.context
        dynamics.context = lambda *given, **named: self._watched(make_context(*given, **named))
        if (around := dynamics.neighborhood) is not None:
            watch.on(around, "update", "pairs")
            watch.on(around, "local", "pairs")
            take = around.column
            around.column = lambda owned: self.columns.append(owned.nbytes // len(owned)) or take(owned)
        if (resolution := dynamics.resolution) is not None:
            resolution.iterations = ITERATIONS
            grid = resolution.grid
            watch.on(grid.spectral, "forward", "transforms", len)
            watch.on(grid.spectral, "backward", "transforms", len)
            # Back with the vector, forth with its products.
            watch.on(grid.spectral, "squares", "transforms", lambda vector: len(vector) + len(SYMMETRIC), calls=2)
            watch.on(grid.spline, "with_ghosts", "splines")
            watch.on(resolution.equations, "solve", "modes")
            make_points = grid.points
            grid.points = lambda position: self._watched_points(make_points(position))

    def _watched(self, context: Context) -> Context:
        self.watch.on(context, "sum_pairs", "pairs")
        if self.dynamics.neighborhood is not None:
            self.watch.on(context.surroundings, "solve_kriging", "pairs", lambda: 0)
        return context

    def _watched_points(self, points: Points) -> Points:
        self.watch.on(points, "at", "splines", lambda parts: len(parts[0]))
        self.watch.on(points, "spread", "splines", lambda values: values.shape[1])
        return points

    @torch.no_grad()
    def evaluate(self, number: int) -> None:
        """Evaluate the rates with halo and list made anew, a moment after the evaluation before, as often as at the
        same places, and settle; what is watched is that of one evaluation."""
        watch, together = self.watch, self.work.together
        watch.reset()
        self.dynamics.forget()
        self.columns.clear()
        for _ in range(together):
            self.dynamics.rates_after(1e-6 * number, self.particles)
        watch.switch()
        companions = {f"{name} {copy}": column for copy in range(2 if self.work.evaluations > together else 0)
                      for name, column in self.particles.columns().items() if name != "id"}
        began = time.perf_counter()
        at_home(self.slab, {**self.particles.columns(), **companions}, self.reach)
        watch.seconds["settling"] = time.perf_counter() - began
        for watched in (watch.seconds, watch.calls, watch.components):
            for part in watched:
                watched[part] /= together

    def seconds(self) -> dict[str, float]:
        """The least over evaluations, as others on the machine may disturb some; the first plans and fills tables."""
        found = []
        for number in range(1 + REPEATS):
            self.evaluate(number)
            found.append(dict(self.watch.seconds))
        return {part: min(seconds.get(part, 0.0) for seconds in found[1:]) for part in PARTS}

    def units(self) -> dict[str, float]:
        """What each part worked on."""
        work, components = self.work, self.watch.components
        return {"pairs": work.pairs(1), "splines": components["splines"] * work.own(1),
                "transforms": components["transforms"] * work.points(1), "modes": ITERATIONS * work.modes(1),
                "formulas": work.own(1), "settling": work.own(1)}

    def speed(self, few: Mapping[str, float], units: Mapping[str, float],
              many: Mapping[str, float]) -> ParticleSpeed:
        """That which explains the seconds `many` of the parts here, and those of `few` units of each."""
        watch, own, listed = self.watch, self.units(), self._listed()
        calls = {"splines": watch.calls["splines"], "transforms": watch.calls["transforms"], "modes": ITERATIONS}
        rates = {}
        for part in PARTS:
            more = own[part] - units[part]  # none of a part that is not there, or of modes too few to tell
            unit = max(many[part] - few[part], 0.0) / more if more > 0 else 0.0
            call = max(few[part] - units[part] * unit, 0.0) / max(calls.get(part, 1), 1)
            rates[part] = Rate(call, unit * (torch.get_num_threads() if part in THREADED else 1))
        iterations = ITERATIONS if self.dynamics.resolution else 0
        # Positions, hence a vector, are sent twice: once more for a list of neighbours that somebody may ask for.
        ghosts = (VECTOR, VECTOR, *self.columns) if self.dynamics.neighborhood else ()
        return ParticleSpeed(rates, {part: watch.calls[part] - 2 * iterations for part in SHARED},
                             {part: watch.components[part] - 6 * iterations for part in SHARED},
                             ghosts, listed, self._block_bytes() if listed else 0.0, watch.calls["pairs"] > 0)

    def _listed(self) -> bool:
        """Whether evaluations asked for the list of neighbours: where the compiled library knows what is summed, it is
        made for the first time here."""
        around = self.dynamics.neighborhood
        return around is not None and around.neighbors.builds > 1

    def _block_bytes(self) -> float:
        """What the term that keeps most keeps of the pairs that are taken together."""
        numbers = (PAIR_VALUES_TOGETHER["cpu"] // term.width * term.settings.numbers_per_pair
                   for term in self.dynamics.model.terms.values() if isinstance(term, PairTerm))
        return BLOCK_COPIES * self.work.real * max(numbers, default=0)


def probed_model(scene: Scene, side: int) -> LagrangianModel:
    """The scene's model with initial weights and forcing, for `side`^3 particles: lengths as many of their spacings as
    in the scene, all else of order one."""
    tracers, turbulence = scene.tracers, expected_turbulence(scene)
    scale = tracers.particles_per_side / side
    flow = FlowUnits(ReferenceScales(
        filter_width=scale * tracers.filter_width, spacing=scale * tracers.spacing, velocity=1.0, acceleration=1.0,
        density_mean=1.0, density=1e-3, density_rate=1.0, sound_speed=10.0, viscosity=1e-3,
        kolmogorov_length=scale * turbulence.kolmogorov_length if turbulence else 0.0),
        scale * scene.interaction_radius, scene.neighbors, scene.seed)
    model = build_model(scene.model.settings, scene.model.terms, flow)
    return model.forced(Forcing(injection_rate=1.0) if scene.injects else None)


def probe_particles(scene: Scene, comm: Comm) -> ParticleSpeed:
    """The speed of the ranks at hand, of the slowest of them; all ranks call it.

    A part takes so long a call, as it does with few particles, and so long a unit, as with more of them. Raises
    ProbeError, on all ranks, where a term cannot be made or evaluated.
    """
    threads = torch.get_num_threads()
    prepare_torch("cpu", comm)
    alone = comm.Split(comm.rank)
    try:
        # More particles where the radius would not fit into half the box.
        reach = (1 + scene.simulation.skin) * scene.interaction_radius / scene.tracers.spacing
        side = max(LEAST_SIDE, math.ceil(2 * reach) + 1)
        few, many, seconds = on_all_ranks(comm, lambda: _measured(scene, alone, side), ProbeError)
        first, second = (dict(zip(PARTS, row)) for row in global_max(comm, np.array(seconds)).tolist())
        return many.speed(first, few.units(), second)
    finally:
        alone.Free()
        torch.set_num_threads(threads)


def _measured(scene: Scene, alone: Comm, side: int) -> tuple[Probe, Probe, list[list[float]]]:
    """Probes of few particles and of more, and the seconds of their parts."""
    try:
        few, many = Probe(scene, alone, side), Probe(scene, alone, 2 * side)
        return few, many, [[found[part] for part in PARTS] for found in (few.seconds(), many.seconds())]
    except Exception as error:  # of a term of the user's, anything
        raise ProbeError(f"{type(error).__name__}: {error}") from error
