"""Whether what a scene asks of a baseline can be done, as `checks` has it of the other sections."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from eddies.particles.terms.settings import WCSPH, FilteredEquations
from eddies.scene.sections import Eulerian

if TYPE_CHECKING:
    from eddies.scene.scene import Scene

# How much faster than its own rate what relaxes may be, as neighbours tell the noise of a particle with the wrong sign:
# 3.6 to 4.0 among particles at random, and in turbulence. Two fifths more for what else makes noise grow: at 4.2 a flow
# at M_t = 0.16 ran away after a turnover, at 5.5 one of 256^3 cells within steps.
NOISE_AMONG_NEIGHBORS = 5.6


def baseline_problems(scene: Scene) -> Iterator[str]:
    """A section of another method; a coarse grid that is finer than what it starts from."""
    simulation = scene.simulation
    if scene.eulerian is not None and (simulation is None or simulation.method != "eulerian"):
        yield '[eulerian]: only read with [simulation] method = "eulerian"; set it, or remove [eulerian]'
    if simulation and simulation.method == "eulerian":
        eulerian = scene.eulerian or Eulerian()
        cells = eulerian.cells_for(scene.tracers.filter_width)
        if cells > scene.flow.cells:
            yield (f"[eulerian] cells = {cells}: must be at most the {scene.flow.cells} of the flow that it starts "
                   "from; lower cells")
        if eulerian.closure == "learned" and "damping" not in scene.model.settings:
            yield ('[eulerian] closure = "learned": takes the rates of the term "damping", which [model] has not; add '
                   "it to its terms, or choose another closure")
        if eulerian.fluid == "compressible" and not scene.flow.compressible:
            yield ('[eulerian] fluid = "compressible": [flow] fluid is incompressible and has no sound speed; set both '
                   "to the same")


def acoustic_step(scene: Scene, form: WCSPH) -> float:
    """The longest step of the term WCSPH, 0.4 h / (c (1 + 0.6 alpha)) (Monaghan 1992), h half the kernel's support."""
    return 0.4 * scene.interaction_radius / 2 / (scene.flow.sound_speed * (1 + 0.6 * form.alpha))


def relaxing_step(scene: Scene, form: FilteredEquations, speed: float) -> float:
    """The longest step of the term FilteredEquations where a component of the velocity has an rms of `speed`."""
    rate = NOISE_AMONG_NEIGHBORS * form.relaxation * 2 * speed / scene.tracers.filter_width
    return scene.simulation.scheme.decay / rate if rate > 0 else math.inf
