"""Training of the pair-force model on frames of the ground truth (Eqs. 12 to 15)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from eddies.learning.losses import kullback_leibler, mean_square_share, soft_histogram
from eddies.learning.optimization import Descent, shared_value
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.ghosts import exchange_ghosts
from eddies.particles.neighbor_list import NeighborList
from eddies.particles.pair_forces import PairModel
from eddies.particles.particle_set import ParticleSet
from eddies.particles.reconstruction import reconstruct, volumes
from eddies.particles.smoothing_kernels import SmoothingKernel

# Histograms of the divergence losses: bins over this many standard deviations to each side.
HISTOGRAM_BINS, HISTOGRAM_REACH = 41, 5.0


@dataclass(frozen=True)
class LossWeights:
    """Weights of Eq. 15: trajectory, field, and the divergences of velocity and acceleration."""

    trajectory: float = 1.0
    field: float = 0.0
    velocity_kl: float = 0.0
    acceleration_kl: float = 0.0


class TrainingFrame:
    """The particles of one moment with their true rates, and the dynamics around them.

    `particles` carry the density that the model will see in a simulation; `acceleration` (n, 3) and `density_rate`
    (n,) are what it should answer.
    """

    def __init__(self, decomposition: SlabDecomposition, model: PairModel, particles: ParticleSet,
                 acceleration: Tensor, density_rate: Tensor) -> None:
        self.dynamics = ParticleDynamics(decomposition, decomposition.length, [model], skin=0.0,
                                         dtype=acceleration.dtype)
        self.particles, self.acceleration, self.density_rate = particles, acceleration, density_rate
        squares = [float(rate.double().square().sum()) for rate in (acceleration, density_rate)]
        *squares, count = global_sum(decomposition.comm, np.array([*squares, len(particles)]))
        #: rms of one component of the acceleration, and of the density rate, over all ranks
        self.acceleration_rms, self.density_rate_rms = np.sqrt(squares[0] / (3 * count)), np.sqrt(squares[1] / count)
        self._row_of_id = dict(zip(particles.id.tolist(), range(len(particles))))

    def rows(self, ids: np.ndarray) -> Tensor:
        """Rows of those of the given particles that this rank owns."""
        return torch.tensor([self._row_of_id[i] for i in ids.tolist() if i in self._row_of_id], dtype=torch.int64)

    def errors(self, rows: Tensor | None = None) -> dict[str, Tensor]:
        """Predicted minus true rates at all owned particles or some of their rows; collective."""
        kept = slice(None) if rows is None else rows
        rates = self.dynamics.rates(self.particles, rows)
        errors = {"velocity": rates["velocity"].to(self.acceleration) - self.acceleration[kept]}
        if "density" in rates:
            errors["density"] = rates["density"].to(self.density_rate) - self.density_rate[kept]
        return errors


class ForceTrainer:
    """Trains a pair-force model, first on trajectories, then on all losses of Eq. 15 together.

    Every step draws a frame, and then either `batch` particles by their ids, or for the field loss all particles in
    and around a cube of the box; both from (seed, step) alone. So the loss is the same on any number of ranks.

    Parameters
    ----------
    decomposition, model, frames : the last all on the same slabs.
    kernel : of the field loss. points_per_side : of the grid on which fields are compared.
    weights : of the losses. total : number of particles over all ranks.
    """

    def __init__(self, decomposition: SlabDecomposition, model: PairModel, frames: Sequence[TrainingFrame],
                 kernel: SmoothingKernel, points_per_side: int, weights: LossWeights, total: int, batch: int,
                 seed: int) -> None:
        self.decomposition, self.comm, self.model, self.frames = decomposition, decomposition.comm, model, frames
        self.kernel, self.points_per_side, self.weights = kernel, points_per_side, weights
        self.total, self.batch, self.seed = total, min(batch, total), seed

    def trajectory_step(self, descent: Descent, step: int) -> dict[str, float]:
        """One step on the trajectory loss of a random batch of particles (Eq. 12); returns the losses."""
        random = np.random.default_rng([self.seed, step])
        frame = self.frames[random.integers(len(self.frames))]
        rows = frame.rows(random.choice(self.total, self.batch, replace=False))
        share = self.weights.trajectory * self._trajectory_share(frame, frame.errors(rows), self.batch)
        norm = descent.step(share)
        loss = shared_value(self.comm, share)
        return {"loss": loss, "trajectory_loss": loss / self.weights.trajectory, "gradient_norm": norm}

    def combined_step(self, descent: Descent, step: int) -> dict[str, float]:
        """One step on all losses of the particles in and around a random cube; returns the losses."""
        random = np.random.default_rng([self.seed, step])
        frame = self.frames[random.integers(len(self.frames))]
        corner = random.uniform(0, self.decomposition.length, 3)
        side = self.decomposition.length / 4
        rows = self._rows_within(frame, corner, side, self.kernel.support)
        count = int(global_sum(self.comm, len(rows)))
        errors = frame.errors(rows)
        shares = {"trajectory": self._trajectory_share(frame, errors, count)}
        if self.weights.field > 0:
            shares["field"] = self._field_share(frame, rows, errors["velocity"], corner, side)
        shares |= self._divergence_shares(frame, rows, errors["velocity"])
        total = sum(getattr(self.weights, name) * share for name, share in shares.items())
        norm = descent.step(total)
        values = {name + "_loss": shared_value(self.comm, share) for name, share in shares.items()}
        return {"loss": shared_value(self.comm, total), **values, "gradient_norm": norm}

    def _trajectory_share(self, frame: TrainingFrame, errors: dict[str, Tensor], count: int) -> Tensor:
        """Eq. 12 with centred differences, each rate in units of its rms at that moment, so that all moments of a
        decaying flow count alike."""
        share = mean_square_share(errors["velocity"], frame.acceleration_rms, count)
        if "density" in errors:
            share = share + mean_square_share(errors["density"], frame.density_rate_rms, count)
        return share

    def _field_share(self, frame: TrainingFrame, rows: Tensor, error: Tensor, corner: np.ndarray,
                     side: float) -> Tensor:
        """Eq. 13 per time step: the kernel average of the acceleration error on the grid points of a cube.

        The velocity predicted one step ahead is compared with that of the true particles, both through the kernel:
        its own error is hundreds of times what a step changes, and the force could not make up for it.
        """
        points = self._grid_points(corner, side)
        count = int(global_sum(self.comm, len(points)))
        surroundings = frame.dynamics.surroundings
        spread = torch.zeros_like(frame.acceleration).index_add(0, rows, error)
        local = torch.cat([spread, exchange_ghosts(surroundings.halo, spread)])
        around = NeighborList(surroundings.box, self.kernel.support, 0.0)
        position = surroundings.local(frame.particles, set()).position
        around.build(points, position, exclude_self=False)
        field = reconstruct(self.kernel, around.pairs(points, position, dtype=error.dtype), self._volumes(frame), local)
        return mean_square_share(field, frame.acceleration_rms, max(count, 1))

    def _volumes(self, frame: TrainingFrame) -> Tensor:
        """Volumes (s,) of the particles of a frame, ghosts included; computed once."""
        if not hasattr(frame, "volumes"):
            surroundings = frame.dynamics.surroundings
            position = surroundings.local(frame.particles, set()).position
            with torch.no_grad():
                pairs = surroundings.neighbors.pairs(position[: len(frame.particles)], position,
                                                     dtype=frame.acceleration.dtype)
                frame.volumes = surroundings.column(volumes(self.kernel, pairs))
        return frame.volumes

    def _divergence_shares(self, frame: TrainingFrame, rows: Tensor, error: Tensor) -> dict[str, Tensor]:
        """Eq. 14 for the acceleration and for the velocity a time a_rms/v_rms ahead, components together."""
        shares = {}
        scales, truth = self.model.scales, frame.acceleration[rows]
        if self.weights.acceleration_kl > 0:
            shares["acceleration_kl"] = self._divergence(truth / frame.acceleration_rms, error / frame.acceleration_rms)
        if self.weights.velocity_kl > 0:
            velocity = frame.particles.velocity[rows].to(truth) / scales.velocity
            shares["velocity_kl"] = self._divergence(velocity, error / frame.acceleration_rms)
        return shares

    def _divergence(self, truth: Tensor, error: Tensor) -> Tensor:
        with torch.no_grad():
            expected = soft_histogram(self.comm, truth, HISTOGRAM_BINS, HISTOGRAM_REACH)
        found = soft_histogram(self.comm, truth + error, HISTOGRAM_BINS, HISTOGRAM_REACH)
        # Every rank has the whole divergence, so its share is an equal part.
        return kullback_leibler(expected, found) / self.comm.size

    def _rows_within(self, frame: TrainingFrame, corner: np.ndarray, side: float, margin: float) -> Tensor:
        """Rows of the owned particles in the periodic cube of some side at `corner`, widened by a margin all around."""
        offset = (frame.particles.position - torch.from_numpy(corner - margin)) % self.decomposition.length
        return torch.nonzero((offset < side + 2 * margin).all(1)).squeeze(1)

    def _grid_points(self, corner: np.ndarray, side: float) -> Tensor:
        """This rank's points (m, 3) of the comparison grid within a periodic cube."""
        slab = self.decomposition
        spacing = slab.length / self.points_per_side
        first = np.ceil(corner / spacing)
        axes = [((f + np.arange(int(side / spacing))) % self.points_per_side) * spacing for f in first]
        axes[2] = axes[2][slab.owner_of(axes[2]) == slab.rank]
        z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
        return torch.from_numpy(np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1))
