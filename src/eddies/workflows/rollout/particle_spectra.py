"""Energy spectra of particles, whatever moves them: of the modes that least squares find in their velocities."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from eddies.io.hdf5 import File, write_table
from eddies.parallel.migration import migrate
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.flow_units import FlowUnits
from eddies.particles.particle_set import ParticleSet
from eddies.particles.resolved_velocity import ResolvedVelocity
from eddies.spectral.spectral_grid import regrid
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.rollout.method import GridModes

log = logging.getLogger("eddies")

RUNS = "model", "truth"
# Of a slab, for the ghost planes of cubic splines; on many ranks the grid has more planes than the closure's.
FEWEST_PLANES = 3
# Residuals at which solves end, from nothing and from a field that is near: in hit after 40 iterations, and after 8
# from the filtered flow or one from what the forces had. What further ones would change of ln E(k) is 1e-3 (rms) up to
# k_d, and 0.1 up to twice that, either way.
TOLERANCE, TOLERANCE_NEAR = 5e-4, 8e-4
# Where particles have gathered and left voids a solve takes more, and gains little by most: see ParticleSpectra.
MOST_ITERATIONS = 100


class ParticleSpectra:
    """Spectra of the model's particles over time, and of the true ones.

    They are those of the resolved velocity of the closure, with the same wavenumbers for all methods: no kernel
    attenuates them, and what they miss at a wavenumber they miss of model and truth alike. A solve starts from a field
    that is known to be near, the filtered flow itself for the true particles, or from nothing, and from none of an
    earlier frame, so that a rollout which goes on from a checkpoint finds the same; in single precision, as frames are
    stored.

    Particles that nothing keeps apart, as those without a force, gather and leave voids. What lives in the voids is
    told by the prior alone, which is far weaker than particles are: the equations get eigenvalues of either size, and
    conjugate gradients take longer. Without a force for T/2 it is 167 iterations in `hit` and 121 in `hit-coarse`
    instead of 44; 111 and 95 at the same positions with velocities of a smooth field, 43 and 45 with such at random
    ones. What follows the first 100 changes ln E(k) by 0.07 at most, of spectra with twice the energy of the true ones
    by then: so a solve ends there, and that it did is said once.
    """

    def __init__(self, truth: GroundTruth) -> None:
        slab = truth.decomposition
        self._slab = SlabDecomposition(slab.comm, slab.length, max(slab.planes, FEWEST_PLANES * slab.size))
        units = FlowUnits(truth.scales, cutoff=0.0, neighbors=0.0)  # no pairs
        self._resolution = ResolvedVelocity.on_slabs(self._slab, units, dtype=torch.float32)
        self._resolution.tolerance, self._resolution.tolerance_foreseen = TOLERANCE, TOLERANCE_NEAR
        self._resolution.most_iterations = MOST_ITERATIONS
        self._rows: dict[str, dict[str, list]] = {name: {"time": [], "energy": []} for name in RUNS}
        self._said = False

    def add(self, name: str, time: float, columns: Mapping[str, np.ndarray], near: GridModes | None = None) -> None:
        """Find the spectrum of the "model" or of the "truth" at a time; columns of this rank's particles, of any slab;
        `near`: a velocity that is known to be near theirs; collective."""
        own = migrate(self._slab, {column: columns[column] for column in ("id", "position", "velocity")})
        start = None if near is None else torch.from_numpy(regrid(near[0], self._resolution.grid.spectral, near[1]))
        with torch.no_grad():
            flow = self._resolution.of(ParticleSet.from_numpy(own), near=start)
        self._resolution.solves.clear()
        if not (flow.converged or self._said):
            self._said = True
            if self._slab.comm.rank == 0:
                log.info("rollout: at time %.3g particles of the %s have gathered and left voids: the solve for their "
                         "spectrum did not converge in %d iterations and left %.1e, as may later ones", time, name,
                         flow.iterations, flow.residual)
        self._rows[name]["time"].append(time)
        self._rows[name]["energy"].append(flow.spectrum[:self._shells].tolist())

    def write(self, file: File) -> None:
        """Write the tables `spectra_of_model` and `spectra_of_truth`: time (m,), wavenumber (shells,), energy (m,
        shells); collective."""
        for name, rows in self._rows.items():
            energy = np.array(rows["energy"]).reshape(-1, self._shells)
            write_table(file, f"spectra_of_{name}", {"time": np.array(rows["time"]), "energy": energy,
                                                     "wavenumber": np.arange(self._shells)})

    def state_dict(self) -> dict[str, Any]:
        """The spectra so far, for a checkpoint."""
        return self._rows

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`."""
        self._rows = state

    @property
    def _shells(self) -> int:
        """Shells 0, 1, ... all of whose modes are resolved; two at least."""
        return max(self._resolution.grid.resolved, 2)
