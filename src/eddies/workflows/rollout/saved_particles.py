"""Particles in checkpoints.

On the same number of ranks, each rank reads the rows that it saved, in the same order. Therefore a restart does not
change the last bit of a sum over particles.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from eddies.io.checkpoint import Block, Checkpoint
from eddies.io.flow_states import restored_modes, saved_modes
from eddies.parallel.communicator import Comm
from eddies.parallel.migration import migrate
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition, block_starts
from eddies.particles.integrators import Integrator
from eddies.particles.particle_set import ParticleSet, as_numpy

MEMORY, BUILT_AT = "memory ", "built at"


def saved_rows(comm: Comm, columns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return the columns (n, ...) of this rank as a state for a checkpoint. Rows are stored in the order of the ranks.

    `columns` holds at least `id` and `position`. Collective.
    """
    rows = np.zeros(comm.size, np.int64)
    rows[comm.rank] = len(columns["id"])
    rows = global_sum(comm, rows)
    first, total = int(rows[:comm.rank].sum()), int(rows.sum())
    return {"columns": list(columns), "rows_of_ranks": rows,
            **{f"particles {name}": Block(column, first, total) for name, column in columns.items()}}


def restored_rows(slab: SlabDecomposition, saved: Checkpoint) -> tuple[dict[str, np.ndarray], bool]:
    """Return the columns of this rank, and whether they are exactly the rows that this rank saved.

    On another number of ranks the columns are those of the particles in this rank's slab. Collective.
    """
    rows = saved["rows_of_ranks"]
    same = len(rows) == slab.size
    starts = np.concatenate([[0], np.cumsum(rows)]) if same else block_starts(int(rows.sum()), slab.size)
    block = int(starts[slab.rank]), int(starts[slab.rank + 1])
    columns = {name: saved.read(f"particles {name}", *block) for name in saved["columns"]}
    return (columns if same else migrate(slab, columns)), same


def particle_state(particles: ParticleSet, integrator: Integrator) -> dict[str, Any]:
    """Return the state of particles for a checkpoint; collective.

    It has the particles that the integrator returned last, the rates that the integrator keeps, the positions at which
    the neighbour list was built, and start values for the next solves.
    """
    dynamics = integrator.dynamics
    columns = particles.to_numpy() | {MEMORY + name: as_numpy(rate) for name, rate in integrator.memory.items()}
    built_at = dynamics.built_at(particles)
    if built_at is not None:
        columns[BUILT_AT] = as_numpy(built_at)
    state = {"time": dynamics.time, "evaluations": dynamics.evaluations,
             **saved_rows(dynamics.decomposition.comm, columns)}
    if dynamics.resolution is not None:
        values = dynamics.resolution.state_dict()
        modes = saved_modes(dynamics.resolution.grid.spectral, as_numpy(values["modes"]))
        solves = [(int(iterations), float(residual), bool(converged))
                  for iterations, residual, converged in dynamics.resolution.solves]
        state |= {"closure": {"times": values["times"].tolist(), "means": values["means"].tolist(),
                              "speed": float(values["speed"]), "solves": solves},
                  "modes": modes}
    return state


def restored_particles(saved: Checkpoint, integrator: Integrator, device: torch.device) -> ParticleSet:
    """Restore the particles of `particle_state` and the state of the integrator; collective.

    The continued run is exact on the same number of ranks. On another number the particles move to their slabs, and the
    neighbour list is built again.
    """
    dynamics = integrator.dynamics
    slab, state = dynamics.decomposition, {"time": torch.tensor(saved["time"], dtype=torch.float64)}
    if dynamics.resolution is not None:
        closure = saved["closure"]
        modes = torch.from_numpy(restored_modes(dynamics.resolution.grid.spectral, saved, 6))
        state |= {"modes": modes, "times": torch.tensor(closure["times"], dtype=torch.float64),
                  "means": torch.tensor(closure["means"], dtype=torch.float64).reshape(-1, 3),
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
