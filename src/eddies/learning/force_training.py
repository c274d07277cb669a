"""Training of the particle model on frames of the ground truth (Eqs. 12 to 15)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from eddies.learning.losses import kullback_leibler, mean_square_share, soft_histogram
from eddies.learning.training import Adam, shared_values
from eddies.parallel.reduction import global_sum
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.exchanges import mean_over_ranks, relative_error, root_mean_square, sum_over_ranks
from eddies.particles.model import LagrangianModel
from eddies.particles.neighborhood import LocalParticles, NeighborList, Neighborhood
from eddies.particles.particle_field import grid_points, reconstruct, volumes
from eddies.particles.particle_set import ParticleSet
from eddies.particles.smoothing_kernels import SmoothingKernel

# Histograms of the divergence losses: number of bins, and reach to each side in standard deviations.
HISTOGRAM_BINS, HISTOGRAM_REACH = 41, 5.0


@dataclass(frozen=True)
class LossWeights:
    """Weights of the losses. The trajectory loss has weight 1.

    `field` is the weight of Eq. 13. `velocity_kl` and `acceleration_kl` are those of Eq. 14 for these two quantities.
    The power loss is not part of Eq. 15.
    """

    field: float = 0.0
    velocity_kl: float = 0.0
    acceleration_kl: float = 0.0
    power: float = 0.0


@dataclass(frozen=True)
class KernelNeighborhood:
    """Halo and neighbour list that reach as far as the support of a kernel, for averages with this kernel.

    `position` (s, 3) and `volumes` (s,) are those of the owned particles, followed by those of the ghosts.
    """

    kernel: SmoothingKernel
    neighborhood: Neighborhood
    position: Tensor
    volumes: Tensor


@dataclass(frozen=True)
class FieldLater:
    """Particles and filtered velocity one frame after a training frame, for the field loss.

    Parameters
    ----------
    position, velocity : true values (n, 3) of the particles, with rows as in the training frame. Positions are not
        wrapped into the box.
    span : time from the frame before the training frame to the frame after it.
    points, field : this rank's grid points (m, 3), and the filtered velocity (m, 3) there.
    """

    position: Tensor
    velocity: Tensor
    span: float
    points: Tensor
    field: Tensor


class TrainingFrame:
    """The particles of one frame with their true rates, and the rates that the model predicts for them.

    The constructor is collective. It evaluates the terms that are linear in their parameters; `kept` holds the results
    by name of the term.

    Parameters
    ----------
    dynamics : evaluates the model on the slabs of the particles. Each frame needs dynamics of its own.
    particles : the particles at the time of the frame.
    acceleration, density_rate : true rates (n, 3) and (n,); the density rate is None if no term reads the density.
    later : the filtered velocity one frame later, with which the field loss compares. If it is None, this loss compares
        with the true accelerations.

    `acceleration_rms` and `density_rate_rms` are the rms of one component of the true rates over all ranks. `total` is
    the number of particles of all ranks.
    """

    def __init__(self, dynamics: ParticleDynamics, particles: ParticleSet, acceleration: Tensor,
                 density_rate: Tensor | None, later: FieldLater | None = None) -> None:
        self.dynamics, self.model, self.decomposition = dynamics, dynamics.model, dynamics.decomposition
        self.particles, self.acceleration, self.density_rate = particles, acceleration, density_rate
        self.later = later
        self.kept = self.model.linear_rates(dynamics.context(particles))
        dynamics.release()  # frees kriging weights, which nonlinear terms may not need
        comm = self.decomposition.comm
        self.total = int(global_sum(comm, len(particles)))
        self.acceleration_rms = root_mean_square(comm, acceleration)
        self.density_rate_rms = None if density_rate is None else root_mean_square(comm, density_rate)
        self._sorted_ids, self._row_of_sorted = torch.sort(particles.id)
        self._within: KernelNeighborhood | None = None

    @cached_property
    def relative_velocity(self) -> Tensor:
        """Velocity minus its mean over all particles, (n, 3); collective."""
        return self.particles.velocity - mean_over_ranks(self.decomposition.comm, self.particles.velocity)

    @cached_property
    def fluctuation(self) -> Tensor:
        """Scaled velocity fluctuation v d / u'^3, (n, 3), of the `relative_velocity` v; collective.

        d is the filter width and u' the rms of one component of v. The scalar product with an acceleration is the power
        in units of u'^3 / d.
        """
        velocity, width = self.relative_velocity, self.model.flow.scales.filter_width
        return velocity * (width / root_mean_square(self.decomposition.comm, velocity) ** 3)

    def rows(self, ids: np.ndarray) -> Tensor:
        """Return the indices of those particles of this rank whose id is among `ids`."""
        wanted = torch.from_numpy(ids).to(self._sorted_ids.device)
        place = torch.searchsorted(self._sorted_ids, wanted)
        inside = place < len(self._sorted_ids)
        place, wanted = place[inside], wanted[inside]
        return self._row_of_sorted[place[self._sorted_ids[place] == wanted]]

    @property
    def averaged(self) -> ParticleSet:
        """The particles at the positions that the field loss uses: their positions in `later` if it is given."""
        return self.particles if self.later is None else replace(self.particles, position=self.later.position)

    @torch.no_grad()
    def within(self, kernel: SmoothingKernel) -> KernelNeighborhood:
        """Return halo, neighbour list and volumes of the `averaged` particles for averages with a kernel; collective.

        The result is kept until another kernel is given.
        """
        if self._within is None or self._within.kernel is not kernel:
            around, averaged = self.dynamics.neighborhood, self.averaged
            # The model's list is used if it reaches as far as the kernel and belongs to the same positions.
            if around is None or around.cutoff < kernel.support * (1 - 1e-9) or self.later is not None:
                around = Neighborhood(self.decomposition, kernel.support, 0.0)
                around.update(averaged)
            position = LocalParticles(averaged.position, around).position
            pairs = around.neighbors.pairs(position[: len(self.particles)], position, dtype=self.acceleration.dtype)
            self._within = KernelNeighborhood(kernel, around, position, around.column(volumes(kernel, pairs)))
        return self._within

    def errors(self, rows: Tensor | None = None, density: Tensor | None = None) -> dict[str, Tensor]:
        """Return predicted minus true rates: "acceleration" (k, 3) and, if the model gives it, "density_rate" (k,).

        Collective. The k particles are those with the indices `rows`, or all owned ones. `density` (n,) replaces the
        density that terms give.
        """
        chosen = slice(None) if rows is None else rows
        rates = self.dynamics.rates(self.particles, rows, self.kept, density)
        errors = {"acceleration": rates.acceleration.to(self.acceleration) - self.acceleration[chosen]}
        if rates.density_rate is not None:
            errors["density_rate"] = rates.density_rate.to(self.density_rate) - self.density_rate[chosen]
        return errors

    @torch.no_grad()
    def seen(self) -> ParticleSet:
        """Return this rank's particles with the density that the terms of the model read; collective.

        This is the density that other terms of the model give, or the stored density if no term gives one.
        """
        rates = self.dynamics.rates(self.particles, self._row_of_sorted[:0], self.kept)
        return self.particles if rates.density is None else replace(self.particles, density=rates.density)


class ForceTrainer:
    """Trains a particle model on single frames, either on the trajectory and power losses alone or on all losses.

    Every step draws a frame at random. A step with the field loss also draws a cube of the box, and takes all particles
    in and around the cube. Any other step draws `batch` particles by their ids. All draws depend on (seed, step) alone,
    so that the loss is the same on any number of ranks.

    Parameters
    ----------
    model, frames : the model and the training frames, all on the same slabs.
    kernel : kernel of the field loss; None without this loss. The loss is evaluated at the points of the filtered
        velocity or, if frames have none, on a grid with about as many points as there are particles.
    weights : weights of the losses.
    batch : number of particles in a step without the field loss.
    seed : seed of all random draws.
    """

    def __init__(self, model: LagrangianModel, frames: Sequence[TrainingFrame], kernel: SmoothingKernel | None,
                 weights: LossWeights, batch: int, seed: int) -> None:
        self.decomposition, self.total = frames[0].decomposition, frames[0].total
        self.comm, self.length = self.decomposition.comm, self.decomposition.length
        self.model, self.frames = model, frames
        self.kernel, self.weights, self.batch, self.seed = kernel, weights, min(batch, self.total), seed
        later, device = frames[0].later, frames[0].particles.position.device
        self._points = (grid_points(self.decomposition, round(self.total ** (1 / 3))).to(device) if later is None
                        else later.points)

    def trajectory_step(self, optimizer: Adam, step: int) -> dict[str, float]:
        """Take an optimiser step on the trajectory loss (Eq. 12) and the power loss of a random batch of particles.

        Return, by name, "loss", the weighted sum of the losses; each unweighted loss, such as "power_loss"; and
        "gradient_norm".
        """
        frame, random = self._drawn(step)
        rows = frame.rows(random.choice(self.total, self.batch, replace=False))
        return self._step(optimizer, self._one_step_shares(frame, rows, frame.errors(rows), self.batch))

    def combined_step(self, optimizer: Adam, step: int) -> dict[str, float]:
        """Take an optimiser step on all losses, in a random cube if there is a field loss, else on a random batch.

        Return the same numbers as `trajectory_step`, for all losses.
        """
        return self._step(optimizer, self._combined_shares(*self._drawn(step)))

    @torch.no_grad()
    def one_step_error(self, frame: TrainingFrame, most: int) -> float:
        """Return the normalised L2 error of the acceleration on a fixed sample of particles of a frame; collective.

        The sample has at most `most` particles. With a power loss, the result is the square root of the squared error
        plus the weighted power loss.
        """
        count = min(most, self.total)
        rows = frame.rows(np.random.default_rng(self.seed).choice(self.total, count, replace=False))
        errors = frame.errors(rows)
        error = relative_error(self.comm, errors["acceleration"], frame.acceleration[rows])
        if self.weights.power > 0:
            share = self._power_share(frame, rows, errors["acceleration"], count)
            error = (error**2 + self.weights.power * shared_values(self.comm, {"power": share})["power"]) ** 0.5
        return error

    @torch.no_grad()
    def combined_error(self, frame: TrainingFrame, draws: int) -> float:
        """Return the square root of the weighted sum of all losses on a frame; collective.

        The sum is a mean over random cubes or batches, `draws` in number, which are the same in every call.
        """
        shares = [self._weighted(self._combined_shares(frame, np.random.default_rng([self.seed, draw])))
                  for draw in range(draws)]
        return float(shared_values(self.comm, {"loss": sum(shares)})["loss"] / draws) ** 0.5

    def _drawn(self, step: int) -> tuple[TrainingFrame, np.random.Generator]:
        """Return the frame of a step, and the random generator that then draws the particles."""
        random = np.random.default_rng([self.seed, step])
        return self.frames[random.integers(len(self.frames))], random

    def _combined_shares(self, frame: TrainingFrame, random: np.random.Generator) -> dict[str, Tensor]:
        """Return this rank's shares of all losses on a frame by name, without their weights.

        `random` draws the cube or the batch.
        """
        if self.weights.field > 0:
            corner, side, reach = random.uniform(0, self.length, 3), self.length / 4, self.kernel.support
            rows = self._in_cube(frame.averaged.position, corner - reach, side + 2 * reach)
            count = int(global_sum(self.comm, len(rows)))
        else:
            rows, count = frame.rows(random.choice(self.total, self.batch, replace=False)), self.batch
        errors = frame.errors(rows)
        shares = self._one_step_shares(frame, rows, errors, count)
        if self.weights.field > 0:
            inside = self._in_cube(self._points, corner, side)
            shares["field"] = self._field_share(frame, rows, errors["acceleration"], inside)
        return shares | self._divergence_shares(frame, rows, errors["acceleration"])

    def _weighted(self, shares: dict[str, Tensor]) -> Tensor:
        return sum(getattr(self.weights, name, 1.0) * share for name, share in shares.items())

    def _step(self, optimizer: Adam, shares: dict[str, Tensor]) -> dict[str, float]:
        """Take an optimiser step on the weighted sum of the losses; see `trajectory_step` for the result."""
        total = self._weighted(shares)
        norm = optimizer.step(total)
        named = {f"{name}_loss": share for name, share in shares.items()}
        return {**shared_values(self.comm, {"loss": total, **named}), "gradient_norm": norm}

    def _one_step_shares(self, frame: TrainingFrame, rows: Tensor, errors: dict[str, Tensor],
                         count: int) -> dict[str, Tensor]:
        """Return this rank's shares of the trajectory loss and the power loss, which are means over `count` particles.

        `rows` are the indices of those particles that this rank owns, and `errors` are their errors. The trajectory
        loss is Eq. 12 with centred differences of the velocity as the true acceleration. Each rate is divided by its
        rms in the frame, so that all frames of a decaying flow count alike. A learned density rate is part of the
        trajectory loss, unless a term of this rate is learned through several steps of the simulation.
        """
        share = mean_square_share(errors["acceleration"], frame.acceleration_rms, count)
        if self.model.regresses_density:
            share = share + mean_square_share(errors["density_rate"], frame.density_rate_rms, count)
        shares = {"trajectory": share}
        if self.weights.power > 0:
            shares["power"] = self._power_share(frame, rows, errors["acceleration"], count)
        return shares

    def _power_share(self, frame: TrainingFrame, rows: Tensor, error: Tensor, count: int) -> Tensor:
        """Return this rank's share of the power loss ((d / u'^3) <(v - <v>) . (a - a_true)>)^2.

        It is the squared error of the power of the forces, in the units of `TrainingFrame.fluctuation`. <.> is the mean
        over particles. Without this loss, a model takes too little energy from the flow, because noise in its inputs
        makes the fitted coefficients too small.
        """
        power = sum_over_ranks(self.comm, (frame.fluctuation[rows].to(error) * error).sum()[None] / count)
        return power.square().sum() / self.comm.size  # every rank has the whole, so its share is an equal part

    def _field_share(self, frame: TrainingFrame, rows: Tensor, error: Tensor, inside: Tensor) -> Tensor:
        """Return this rank's share of the field loss, Eq. 13: a mean square error of kernel averages <.> on a grid.

        The error of the velocity is divided by the time step and by the rms acceleration. The mean is over the grid
        points of all ranks with the indices `inside`. `rows` are the indices of the particles whose accelerations a
        were predicted, and `error` (k, 3) is a - a_true.

        Without a filtered velocity, the error is <a - a_true> at the true positions. Here the predicted velocity after
        a step is compared with the true one, both averaged by the kernel, so the error of the kernel cancels. The error
        of the kernel is far larger than the change of velocity in a step, and the force cannot correct it.

        With a filtered velocity u one frame later, the error is (<v> - u) / span. v = v_before + span a is the model's
        velocity after a midpoint step of length span, from the frame before to the frame after. True accelerations are
        centred differences, so v = v_true + span (a - a_true), where v_true is the true velocity in the frame after.
        The positions at the end of the step are the true ones, because a midpoint step computes them from the velocity
        in its middle, not from a. So the error is <a - a_true> plus (<v_true> - u) / span, the error of the kernel.
        """
        within, later, points = frame.within(self.kernel), frame.later, self._points[inside]
        change = torch.zeros_like(frame.acceleration).index_add(0, rows, error)
        if later is not None:
            change = change + later.velocity / later.span
        local = within.neighborhood.column(change)
        around = NeighborList(within.neighborhood.box, self.kernel.support, 0.0)
        around.build(points, within.position, exclude_self=False)
        pairs = around.pairs(points, within.position, dtype=error.dtype)
        field = reconstruct(self.kernel, pairs, within.volumes, local)
        if later is not None:
            field = field - later.field[inside] / later.span
        count = int(global_sum(self.comm, len(points)))
        return mean_square_share(field, frame.acceleration_rms, max(count, 1))

    def _divergence_shares(self, frame: TrainingFrame, rows: Tensor, error: Tensor) -> dict[str, Tensor]:
        """Return this rank's shares of Eq. 14 for acceleration and velocity, each with all components in one histogram.

        The predicted velocity is the true velocity plus (v_rms / a_rms) times the error of the acceleration.
        """
        shares, truth = {}, frame.acceleration[rows]
        if self.weights.acceleration_kl > 0:
            shares["acceleration_kl"] = self._divergence(truth / frame.acceleration_rms, error / frame.acceleration_rms)
        if self.weights.velocity_kl > 0:
            velocity = frame.relative_velocity[rows].to(truth) / self.model.flow.scales.velocity
            shares["velocity_kl"] = self._divergence(velocity, error / frame.acceleration_rms)
        return shares

    def _divergence(self, truth: Tensor, error: Tensor) -> Tensor:
        with torch.no_grad():
            expected = soft_histogram(self.comm, truth, HISTOGRAM_BINS, HISTOGRAM_REACH)
        predicted = soft_histogram(self.comm, truth + error, HISTOGRAM_BINS, HISTOGRAM_REACH)
        # Every rank has the whole divergence, so its share is an equal part.
        return kullback_leibler(expected, predicted) / self.comm.size

    def _in_cube(self, points: Tensor, corner: np.ndarray, side: float) -> Tensor:
        """Return the indices of those points (m, 3) that lie in a cube with this lowest `corner` and this `side`.

        The cube may extend across faces of the periodic box.
        """
        offset = (points - torch.from_numpy(corner).to(points.device)) % self.length
        return torch.nonzero((offset < side).all(1)).squeeze(1)
