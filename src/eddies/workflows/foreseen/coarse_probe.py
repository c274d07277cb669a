"""How fast the ranks at hand step the coarse grid of a rollout, with its closure, and move particles on it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from eddies.parallel.communicator import Comm
from eddies.scene.scene import Eulerian, Initial, Scene
from eddies.workflows.foreseen.cost_model import Speed, probe
from eddies.workflows.foreseen.estimates import ground_truth_alone
from eddies.workflows.rollout.eulerian_run import closure_of


def coarse_scene(scene: Scene) -> Scene:
    """A direct simulation with the grid, the fluid, the precision and the particles of a scene's coarse one."""
    eulerian, tracers = scene.eulerian or Eulerian(), scene.tracers
    cells = eulerian.cells_for(tracers.filter_width)
    sound_speed = scene.flow.sound_speed if eulerian.compressible else None
    flow = replace(scene.flow, cells=cells, fluid=eulerian.fluid, sound_speed=sound_speed,
                   precision=scene.simulation.precision)
    return replace(ground_truth_alone(scene), flow=flow, initial=Initial(peak_wavenumber=1.0), forcing=None,
                   spin_up=None, time=replace(scene.time, stepper="etdrk4", step=None),
                   tracers=replace(tracers, field_cells=min(cells, tracers.cells), forced=False))


def probe_coarse(scene: Scene, comm: Comm) -> Speed:
    """The speed of the ranks at hand on the coarse grid; all ranks call it."""
    settings = scene.eulerian or Eulerian()
    if settings.form.learned:  # which is not there yet; the work is that of another drag on the modes
        settings = replace(settings, closure="spectral")
    passed = settings.filter_passed(scene.tracers.filter_width)
    return probe(coarse_scene(scene), comm, closure=lambda grid: closure_of(settings, grid, passed, Path(), None))
