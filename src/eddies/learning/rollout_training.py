"""Training through several steps of the simulation: the trajectory loss of Eq. 12 over a window of frames."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from eddies.learning.losses import mean_square_share
from eddies.learning.training import Adam, shared_values
from eddies.parallel.communicator import Comm
from eddies.parallel.migration import IdOrder
from eddies.parallel.reduction import global_sum
from eddies.particles.exchanges import redistributed, root_mean_square
from eddies.particles.integrators import Integrator
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.particles.resolved_velocity import ResolvedVelocity

# Lower bound of the unit of a band's energy error (see `energy_units`), as a share of the largest unit of any band.
SLOWEST = 0.1


@dataclass(frozen=True)
class TrainingWindow:
    """Particles at one time and their true future, in the order of their ids, each rank a block of ids (`id_block`).

    Parameters
    ----------
    particles : the particles at the start.
    velocity, density : true values (frames, n, 3) and (frames, n) at the end of frame intervals 1, 2, ...; rows are as
        in `particles`. The density may be None.
    energies : true kinetic energy (frames, bands) in bands of wavenumbers at the end of each frame interval; None
        without the energy loss.
    unforced : the same for particles that keep their velocity from the start.
    """

    particles: ParticleSet
    velocity: Tensor
    density: Tensor | None
    energies: Tensor | None = None
    unforced: Tensor | None = None


class RolloutTrainer:
    """Trains a model on rollouts from true initial states.

    Every training step draws a window at random and advances all its particles by the integrator of the simulation. The
    random choice depends on (seed, step) alone. The loss of a frame is <|v - v_true|^2> / <|v_true - v_start|^2>, with
    means <.> over all particles. It is 1 for particles without acceleration, so all frames count alike. A density whose
    rate is learned has a loss of the same form.

    The energy loss is the squared error of the kinetic energy in a band of wavenumbers, averaged over the bands. The
    error of a band in a frame is in units of the error of particles without acceleration. So this loss, too, is about 1
    without acceleration. It is needed because noise in the inputs makes fitted forces too weak. Such forces take too
    much energy from some scales and too little from others, and the error of the velocity hardly shows this.

    The gradient is that of the whole rollout. It goes through the forces of all steps, the distances of neighbours, the
    halo, the changes of rank, and the grid of the resolved velocity. The backward pass computes each step again, so
    that memory holds the intermediate results of only one step.

    Parameters
    ----------
    integrator : advances the particles.
    windows : true trajectories of the particles.
    frame_interval, steps_per_frame : time between frames, and number of time steps in this time.
    energy_weight : weight of the energy loss; if it is zero, windows need no energies.
    resolution : computes the band energies of particles; unused if `energy_weight` is zero.
    seed : seed of the random choice of windows.
    """

    def __init__(self, comm: Comm, integrator: Integrator, windows: Sequence[TrainingWindow], frame_interval: float,
                 steps_per_frame: int, energy_weight: float, resolution: ResolvedVelocity | None,
                 seed: int) -> None:
        self.comm, self.integrator, self.windows = comm, integrator, windows
        self.steps_per_frame, self.time_step = steps_per_frame, frame_interval / steps_per_frame
        self.energy_weight, self.resolution, self.seed = energy_weight, resolution, seed
        self.total = int(global_sum(comm, len(windows[0].particles)))
        self.units = energy_units(windows) if energy_weight > 0 else None

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
        """Return this rank's shares of "rollout_loss", that of the velocity, and, if they are used, "density_loss" and
        "energy_loss"; collective.

        A loss is the mean over the first `horizon` frames of the window. The energy loss includes its weight. The sum
        of the shares of all ranks is the loss.
        """
        shares: dict[str, list[Tensor]] = defaultdict(list)
        for reached, particles in self._frames(window.particles, horizon):
            for name, error, change in self._errors(window, reached, particles):
                shares[name].append(mean_square_share(error, root_mean_square(self.comm, change), self.total))
            if self.energy_weight > 0:
                shares["energy_loss"].append(self.energy_weight * self._energy_share(window, reached, particles))
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

        def energies_of(position: Tensor, velocity: Tensor) -> tuple[Tensor]:
            nonlocal near
            moved = replace(particles, position=position, velocity=velocity)
            energies = self.resolution.band_energies(moved, near=near)
            near = self.resolution.latest
            return energies,

        energies, = _recomputed(energies_of, particles.position, particles.velocity)
        true = window.energies[frame]
        return ((energies - true) / (true * self.units[frame])).square().mean() / self.comm.size

    def _frames(self, particles: ParticleSet, horizon: int) -> Iterator[tuple[int, ParticleSet]]:
        """Yield the number, from 0 on, and the particles, in the order of their ids, of each frame that the rollout
        reaches."""
        memory: dict[str, Tensor] = {}
        self.integrator.dynamics.begin()
        for reached in range(horizon):
            for _ in range(self.steps_per_frame):
                particles, memory = self._advanced(particles, memory)
            order = IdOrder(self.comm, as_numpy(particles.id), self.total)
            yield reached, ParticleSet(**{name: redistributed(order, column)
                                          for name, column in particles.columns().items()})

    def _advanced(self, particles: ParticleSet, memory: dict[str, Tensor]) -> tuple[ParticleSet, dict[str, Tensor]]:
        """Return the particles and the integrator's memory after one time step.

        The backward pass computes the step again.
        """
        given, carried, after = list(particles.columns()), list(memory), ([], [])
        state = self.integrator.dynamics.state_dict()

        def advance(*columns: Tensor) -> tuple[Tensor, ...]:
            # The neighbour list is rebuilt and the predictions are restored, so that the backward pass repeats the
            # step exactly.
            self.integrator.dynamics.forget()
            self.integrator.dynamics.load_state_dict(state)
            start = ParticleSet(**dict(zip(given, columns)))
            self.integrator.restore(start, dict(zip(carried, columns[len(given):])))
            end, rates = self.integrator.step(start, self.time_step).columns(), self.integrator.memory
            after[0][:], after[1][:] = end, rates
            return *end.values(), *rates.values()

        columns = _recomputed(advance, *particles.columns().values(), *memory.values())
        return ParticleSet(**dict(zip(after[0], columns))), dict(zip(after[1], columns[len(after[0]):]))

    def _errors(self, window: TrainingWindow, frame: int,
                particles: ParticleSet) -> Iterator[tuple[str, Tensor, Tensor]]:
        """Yield the name of the loss of the velocity, its error (n, 3) and its true change (n, 3) since the start.

        If the model learns the rate of the density, also yield the same of the density: a name, (n,) and (n,).
        """
        true = window.velocity[frame]
        yield "rollout_loss", particles.velocity - true, true - window.particles.velocity
        if self.integrator.dynamics.model.learns_density:
            true = window.density[frame]
            yield "density_loss", particles.density - true, true - window.particles.density


def energy_units(windows: Sequence[TrainingWindow]) -> Tensor:
    """Return the relative error of the band energies of particles without acceleration: (frames, bands).

    It is the rms over windows. In each frame, errors below SLOWEST times the largest of any band are raised to this
    bound.
    """
    errors = torch.stack([window.unforced / window.energies - 1 for window in windows])
    units = errors.square().mean(0).sqrt()
    return torch.maximum(units, SLOWEST * units.amax(1, keepdim=True))


class _Recomputed(torch.autograd.Function):
    """function(*columns), a tuple, whose backward pass calls the function again and adds the gradients of parameters.

    `torch.utils.checkpoint` is not used, because it loads torch's compiler, which takes two seconds. The first call
    is without gradients, so a function must not depend on `torch.is_grad_enabled()`.
    """

    @staticmethod
    def forward(ctx: Any, function: Callable[..., tuple[Tensor, ...]], anchor: Tensor,
                *columns: Tensor) -> tuple[Tensor, ...]:
        """The `anchor` requires a gradient, so that the results do, even if only parameters have one."""
        ctx.function = function
        ctx.save_for_backward(*columns)
        ctx.set_materialize_grads(False)
        return function(*columns)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        columns = [column.detach().requires_grad_(column.requires_grad) for column in ctx.saved_tensors]
        with torch.enable_grad():
            results = ctx.function(*columns)
        given = [(result, gradient) for result, gradient in zip(results, gradients)
                 if gradient is not None and result.requires_grad]
        if given:
            torch.autograd.backward(*zip(*given))
        return None, None, *(column.grad for column in columns)


def _recomputed(function: Callable[..., tuple[Tensor, ...]], *columns: Tensor) -> tuple[Tensor, ...]:
    """Return function(*columns) without storing intermediate results: the backward pass calls the function again."""
    if not torch.is_grad_enabled():
        return function(*columns)
    return _Recomputed.apply(function, torch.zeros((), requires_grad=True), *columns)
