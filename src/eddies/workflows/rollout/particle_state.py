"""Particles between two steps with what their integrator and its dynamics go on from, to and from a checkpoint."""

from __future__ import annotations

from typing import Any

import torch

from eddies.io.checkpoint import Block, Checkpoint
from eddies.particles.integrators import Integrator
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.workflows.rollout.saved_rows import restored_rows, saved_rows

MEMORY, BUILT_AT = "memory ", "built at"
MODES_AXIS = 4  # of ky, by which the ranks share the modes (moments, 2, 3, kz, ky, kx) of the closure


def particle_state(particles: ParticleSet, integrator: Integrator) -> dict[str, Any]:
    """The particles last returned by an integrator as they stand on the ranks, the rates that it remembers of them,
    where they were when halo and list were built, and what the closure foresees; collective."""
    dynamics = integrator.dynamics
    columns = particles.to_numpy() | {MEMORY + name: as_numpy(rate) for name, rate in integrator.memory.items()}
    built_at = dynamics.built_at(particles)
    if built_at is not None:
        columns[BUILT_AT] = as_numpy(built_at)
    state = {"time": dynamics.time, "evaluations": dynamics.evaluations,
             **saved_rows(dynamics.decomposition.comm, columns)}
    if dynamics.resolution is not None:
        known, grid = dynamics.resolution.state_dict(), dynamics.resolution.grid
        modes = Block(as_numpy(known["modes"]), int(grid.spectral.column_starts[dynamics.decomposition.rank]),
                      grid.spectral.modes, MODES_AXIS)
        solves = [(int(iterations), float(residual), bool(converged))
                  for iterations, residual, converged in dynamics.resolution.solves]
        state |= {"closure": {"times": known["times"].tolist(), "speed": float(known["speed"]), "solves": solves},
                  "modes": modes}
    return state


def restored_particles(saved: Checkpoint, integrator: Integrator, device: torch.device) -> ParticleSet:
    """Inverse of `particle_state` on the same number of ranks. On another one halo and list are built anew, for
    particles that are brought to their slabs. Collective."""
    dynamics = integrator.dynamics
    slab, state = dynamics.decomposition, {"time": torch.tensor(saved["time"], dtype=torch.float64)}
    if dynamics.resolution is not None:
        starts, closure = dynamics.resolution.grid.spectral.column_starts, saved["closure"]
        modes = saved.read("modes", int(starts[slab.rank]), int(starts[slab.rank + 1]), MODES_AXIS)
        state |= {"modes": torch.from_numpy(modes), "times": torch.tensor(closure["times"], dtype=torch.float64),
                  "speed": torch.tensor(closure["speed"], dtype=torch.float64)}
        dynamics.resolution.solves = [tuple(solve) for solve in closure["solves"]]
    dynamics.load_state_dict(state)
    dynamics.evaluations = saved["evaluations"]
    columns, same = restored_rows(slab, saved)
    particles = ParticleSet.from_numpy(columns, device)
    if same and BUILT_AT in columns:
        dynamics.rebuild(particles, torch.from_numpy(columns[BUILT_AT]).to(device))
    memory = {name.removeprefix(MEMORY): torch.from_numpy(column).to(device) for name, column in columns.items()
              if name.startswith(MEMORY)}
    integrator.restore(particles if memory else None, memory)
    return particles
