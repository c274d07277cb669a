"""Whether what a scene asks of a baseline can be done, as `checks` has it of the other sections."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from eddies.scene.sections import Eulerian, Wcsph

if TYPE_CHECKING:
    from eddies.scene.scene import Scene


def baseline_problems(scene: Scene) -> Iterator[str]:
    """Sections of another method; a step that sound outruns; a coarse grid that is finer than what it starts from."""
    simulation = scene.simulation
    for name in ("wcsph", "eulerian"):
        if getattr(scene, name) is not None and (simulation is None or simulation.method != name):
            yield f'[{name}]: only read with [simulation] method = "{name}"; set it, or remove [{name}]'
    if simulation and simulation.method == "wcsph" and simulation.step > acoustic_step(scene):
        yield (f'[simulation] step = {simulation.step:g}: method = "wcsph" must resolve sound, with a step of at most '
               f"0.4 h / (c (1 + 0.6 alpha)) = {acoustic_step(scene):.3g}, h half the support of {scene.neighbors:g} "
               "neighbors and c [flow] sound_speed; lower step")
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


def acoustic_step(scene: Scene, form: Any = None) -> float:
    """The longest step of WCSPH, 0.4 h / (c (1 + 0.6 alpha)) (Monaghan 1992), h half the kernel's support; of the
    method, or of a term with settings of that `form`."""
    h, alpha = scene.interaction_radius / 2, (form or scene.wcsph or Wcsph()).alpha
    return 0.4 * h / (scene.flow.sound_speed * (1 + 0.6 * alpha))
