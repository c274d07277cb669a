"""Training of the smoothing kernel on filtered fields and the particles in them (Eqs. 8 to 11)."""

import numpy as np
import torch
from torch import Tensor

from eddies.learning.losses import mean_square_share
from eddies.learning.training import Adam, shared_values
from eddies.parallel.reduction import global_sum
from eddies.particles.exchanges import mean_over_ranks
from eddies.particles.particle_field import ParticleField
from eddies.particles.smoothing_kernels import KernelNetwork


class KernelSample:
    """A filtered field on the grid points of a slab, and the particles in this slab, at one time.

    Parameters
    ----------
    particles : the particles in the slab, with their velocities.
    field, gradient : filtered velocity (m, 3) and its gradient (m, 3, 3) [component, direction] at the m grid points
        of the slab, z slowest.

    `mean_square` holds two numbers: the mean square of a component of the filtered velocity minus its mean, over the
    whole grid, and that of a component of its gradient. The constructor and `errors_of` are collective.
    """

    def __init__(self, particles: ParticleField, field: Tensor, gradient: Tensor) -> None:
        self.particles, self.decomposition = particles, particles.decomposition
        self.field, self.gradient = field.to(particles.dtype), gradient.to(particles.dtype)
        mean = mean_over_ranks(self.decomposition.comm, self.field.double()).to(self.field)
        self.mean_square = self._mean_squares(self.field - mean, self.gradient)

    def own_rows(self, points: np.ndarray) -> Tensor:
        """Return the rows in `field` of those `points` that lie in this slab.

        `points` are indices in the whole grid, z slowest.
        """
        n = self.decomposition.planes
        own = points[(points // n**2 >= self.decomposition.start) & (points // n**2 < self.decomposition.stop)]
        return torch.from_numpy(own - self.decomposition.start * n**2)

    def errors_of(self, velocity: Tensor, gradient: Tensor) -> tuple[float, float]:
        """Return the normalised L2 errors, over the whole grid, of a velocity (m, 3) and a gradient (m, 3, 3)."""
        squares = self._mean_squares(velocity - self.field, gradient - self.gradient)
        return tuple(np.sqrt(np.array(squares) / self.mean_square))

    def _mean_squares(self, velocity: Tensor, gradient: Tensor) -> tuple[float, float]:
        sums = np.array([float(part.double().square().sum()) for part in (velocity, gradient)])
        return tuple(global_sum(self.decomposition.comm, sums) / (self.decomposition.planes**3 * np.array([3, 9])))


class KernelTrainer:
    """Fits a kernel network to samples. Each step lowers the loss of Eq. 8 on random grid points of one sample.

    The sample and the points depend on (seed, step) alone, so that the loss is the same on any number of ranks.

    Parameters
    ----------
    network : the kernel.
    samples : the fields to which the kernel is fitted.
    gradient_weight, normalization_weight : weights of the gradient loss and of the normalisation loss in Eq. 8; the
        velocity loss has weight 1.
    points : number of random grid points per step; all points are taken if the grid has fewer.
    seed : seed of the random choice of samples and points.
    """

    def __init__(self, network: KernelNetwork, samples: list[KernelSample], gradient_weight: float,
                 normalization_weight: float, points: int, seed: int) -> None:
        self.network, self.samples = network, samples
        self.gradient_weight, self.normalization_weight = gradient_weight, normalization_weight
        self.comm, self.total = samples[0].decomposition.comm, samples[0].decomposition.planes**3
        self.points, self.seed = min(points, self.total), seed

    def step(self, optimizer: Adam, step: int) -> dict[str, float]:
        """Take an optimiser step; collective.

        Return, by name, "loss", the weighted sum of the losses; each unweighted loss; and "gradient_norm".
        """
        random = np.random.default_rng([self.seed, step])
        sample = self.samples[random.integers(len(self.samples))]
        rows = sample.own_rows(np.sort(random.choice(self.total, self.points, replace=False)))
        kernel = self.network.table()
        velocity, gradient = sample.particles.on_grid(kernel, sample.particles.volumes_by_table(kernel), rows)
        # Errors of velocity and gradient are in units of the rms of the filtered quantity.
        error = velocity - sample.field[rows]
        shares = {"velocity": mean_square_share(error, sample.mean_square[0] ** 0.5, self.points)}
        total = shares["velocity"]
        if self.gradient_weight > 0:
            error = (gradient - sample.gradient[rows]).flatten(1)
            shares["gradient"] = mean_square_share(error, sample.mean_square[1] ** 0.5, self.points)
            total = total + self.gradient_weight * shares["gradient"]
        if self.normalization_weight > 0:
            shares["normalization"] = (self.network.integral() - 1) ** 2 / self.comm.size
            total = total + self.normalization_weight * shares["normalization"]
        norm = optimizer.step(total)
        return {**shared_values(self.comm, {"loss": total, **shares}), "gradient_norm": norm}
