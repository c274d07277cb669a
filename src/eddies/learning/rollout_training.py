"""Training through several steps of the simulation: the trajectory loss of Eq. 12 over a window of frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from eddies.learning.losses import mean_square_share
from eddies.learning.optimization import Adam, shared_values
from eddies.parallel.communicator import Comm
from eddies.parallel.reduction import global_sum
from eddies.particles.exchanges import root_mean_square
from eddies.particles.integrators import Integrator
from eddies.particles.particle_set import ParticleSet
from eddies.particles.resolved_velocity import ResolvedVelocity

# Lower bound of the typical energy change of a band (see `mean_losses`), as a share of the largest change of any band.
SLOWEST = 0.1


@dataclass(frozen=True)
class TrainingWindow:
    """Particles at one time and their true future.

    Parameters
    ----------
    particles : the particles at the start.
    velocity, density : true values (frames, n, 3) and (frames, n) at the end of frame intervals 1, 2, ...; rows are as
        in `particles`. The density may be None.
    energies : true kinetic energy (frames + 1, bands) in bands of wavenumbers, at the start and at the end of each
        frame interval; None without the energy loss.
    """

    particles: ParticleSet
    velocity: Tensor
    density: Tensor | None
    energies: Tensor | None = None


class RolloutTrainer:
    """Trains a model on rollouts from true initial states.

    Every training step draws a window at random and advances all its particles by the integrator of the simulation. The
    random choice depends on (seed, step) alone. The loss of a frame is <|v - v_true|^2> / <|v_true - v_start|^2>, with
    means <.> over all particles. It is 1 for particles without acceleration, so all frames count alike. A density whose
    rate is learned has a loss of the same form.

    The energy loss is the squared error of the kinetic energy in a band of wavenumbers, averaged over the bands. The
    error is in units of the energy that the band loses on average from the start to the frame. This loss is needed
    because noise in the inputs makes fitted forces too weak. Such forces take too much energy from some scales and too
    little from others, and the error of the velocity hardly shows this.

    The gradient is that of the whole rollout. It goes through the forces of all steps, the distances of neighbours, the
    halo, and the grid of the resolved velocity. The backward pass computes each step again, so that memory holds the
    intermediate results of only one step.

    Parameters
    ----------
    integrator : advances the particles. Its dynamics must have `fixed_ranks`.
    windows : true trajectories of the particles in this rank's slab.
    frame_interval, steps_per_frame : time between frames, and number of time steps in this time.
    energy_weight : weight of the energy loss; if it is zero, windows need no energies.
    resolution : computes the band energies of particles; unused if `energy_weight` is zero.
    seed : seed of the random choice of windows.
    stationary : whether the flow is forced, so that its bands lose no energy on average. The unit of the energy loss is
        then the rms change of a band's energy.
    """

    def __init__(self, comm: Comm, integrator: Integrator, windows: Sequence[TrainingWindow], frame_interval: float,
                 steps_per_frame: int, energy_weight: float, resolution: ResolvedVelocity | None,
                 seed: int, stationary: bool = False) -> None:
        self.comm, self.integrator, self.windows = comm, integrator, windows
        self.steps_per_frame, self.time_step = steps_per_frame, frame_interval / steps_per_frame
        self.energy_weight, self.resolution, self.seed = energy_weight, resolution, seed
        self.total = int(global_sum(comm, len(windows[0].particles)))
        self.losses = mean_losses(windows, stationary) if energy_weight > 0 else None

    def step(self, optimizer: Adam, step: int, horizon: int) -> dict[str, float]:
        """Take an optimiser step on the first `horizon` frames of a random window.

        Return, by name, "loss", the sum of the losses; each loss of `loss_shares`; and "gradient_norm".
        """
        random = np.random.default_rng([self.seed, step])
        window = self.windows[random.integers(len(self.windows))]
        shares = self.loss_shares(window, horizon)
        total = sum(shares.values())
        norm = optimizer.step(total)
        values = shared_values(self.comm, shares)
        return {"loss": sum(values.values()), **values, "gradient_norm": norm}

    def loss_shares(self, window: TrainingWindow, horizon: int) -> dict[str, Tensor]:
        """Return this rank's shares of "rollout_loss" and, if it is used, "energy_loss"; collective.

        A loss is the mean over the first `horizon` frames of the window. The energy loss includes its weight. The sum
        of the shares of all ranks is the loss.
        """
        shares: dict[str, list[Tensor]] = {"rollout_loss": []}
        for reached, particles in self._frames(window.particles, horizon):
            shares["rollout_loss"] += [mean_square_share(error, root_mean_square(self.comm, change), self.total)
                                       for error, change in self._errors(window, reached, particles)]
            if self.energy_weight > 0:
                shares.setdefault("energy_loss", []).append(
                    self.energy_weight * self._energy_share(window, reached, particles))
        return {name: sum(parts) / horizon for name, parts in shares.items()}

    @torch.no_grad()
    def validation_error(self, window: TrainingWindow, horizon: int) -> float:
        """Return the square root of the summed losses of the first `horizon` frames of a window; collective.

        With the loss of the velocity alone, it is 1 for particles without acceleration.
        """
        shares = self.loss_shares(window, horizon)
        return sum(shared_values(self.comm, shares).values()) ** 0.5

    def _energy_share(self, window: TrainingWindow, frame: int, particles: ParticleSet) -> Tensor:
        """Return this rank's share of the energy loss of a frame, without its weight.

        Every rank computes the whole loss, so the shares are equal parts.
        """
        # The solve for the resolved velocity starts from zero, as for the true energies: a prediction would change the
        # energies. In the backward pass the solve starts from the solution of the forward pass and takes no iteration.
        near: Tensor | None = None

        def energies_of(position: Tensor, velocity: Tensor) -> Tensor:
            nonlocal near
            moved = replace(particles, position=position, velocity=velocity)
            energies = self.resolution.band_energies(moved, near=near)
            near = self.resolution.latest
            return energies

        energies = _recomputed(energies_of, particles.position, particles.velocity)
        true = window.energies[frame + 1]
        return ((energies - true) / (true * self.losses * (frame + 1))).square().mean() / self.comm.size

    def _frames(self, particles: ParticleSet, horizon: int) -> Iterator[tuple[int, ParticleSet]]:
        """Yield the number, from 0 on, and the particles of each frame that the rollout reaches."""
        memory: dict[str, Tensor] = {}
        self.integrator.dynamics.begin()
        for reached in range(horizon):
            for _ in range(self.steps_per_frame):
                particles, memory = self._advanced(particles, memory)
            yield reached, particles

    def _advanced(self, particles: ParticleSet, memory: dict[str, Tensor]) -> tuple[ParticleSet, dict[str, Tensor]]:
        """Return the particles and the integrator's memory after one time step.

        The backward pass computes the step again.
        """
        given, carried, after = particles.columns(), list(memory), ([], [])
        state = self.integrator.dynamics.state_dict()
        del given["id"]

        def advance(*columns: Tensor) -> tuple[Tensor, ...]:
            # The neighbour list is rebuilt and the predictions are restored, so that the backward pass repeats the
            # step exactly.
            self.integrator.dynamics.forget()
            self.integrator.dynamics.load_state_dict(state)
            start = ParticleSet(particles.id, **dict(zip(given, columns)))
            self.integrator.restore(start, dict(zip(carried, columns[len(given):])))
            end = self.integrator.step(start, self.time_step).columns()
            del end["id"]
            after[0][:], after[1][:] = end, self.integrator.memory
            return *end.values(), *self.integrator.memory.values()

        columns = _recomputed(advance, *given.values(), *memory.values())
        moved = ParticleSet(particles.id, **dict(zip(after[0], columns)))
        return moved, dict(zip(after[1], columns[len(after[0]):]))

    def _errors(self, window: TrainingWindow, frame: int,
                particles: ParticleSet) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield the error (n, 3) of the velocity, and the true change (n, 3) of the velocity since the window's start.

        If the model learns the rate of the density, also yield the error (n,) and the true change (n,) of the density.
        """
        true = window.velocity[frame]
        yield particles.velocity - true, true - window.particles.velocity
        if self.integrator.dynamics.model.learns_density:
            true = window.density[frame]
            yield particles.density - true, true - window.particles.density


# The wrapper of `checkpoint` loads torch's compiler, which takes two seconds.
UNWRAPPED = getattr(checkpoint, "__wrapped__", checkpoint)


def mean_losses(windows: Sequence[TrainingWindow], stationary: bool = False) -> Tensor:
    """Return the typical change of ln(energy) in a frame interval for each band of wavenumbers, (bands,).

    The change is the absolute value of the mean over windows, or the rms over windows if `stationary`. Changes below
    SLOWEST times the largest change of any band are raised to this bound.
    """
    changes = torch.stack([window.energies[-1] / window.energies[0] for window in windows]).log()
    change = changes.square().mean(0).sqrt() if stationary else changes.mean(0)
    losses = (change / (len(windows[0].energies) - 1)).abs()
    return losses.clamp_min(SLOWEST * float(losses.max()))


def _recomputed(function: Callable[..., Any], *columns: Tensor) -> Any:
    """Return function(*columns) without storing intermediate results: the backward pass calls the function again."""
    if not torch.is_grad_enabled():
        return function(*columns)
    return UNWRAPPED(function, *columns, use_reentrant=False, preserve_rng_state=False)
