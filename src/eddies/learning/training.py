"""The course of a training: optimiser, phases, validation, the best state of the model, and a state for checkpoints."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.adam import adam  # not the class Adam, which loads torch's compiler and takes two seconds

from eddies.parallel.communicator import Comm
from eddies.parallel.halo import HaloError
from eddies.parallel.reduction import global_sum, sum_flat


class Adam:
    """The optimiser Adam (Kingma and Ba 2014). The learning rate falls geometrically over `steps` steps.

    It falls from `first_rate` to `last_rate`. The global loss is the sum of the shares of all ranks. Gradients are
    summed over ranks in one message, so that all ranks, also those without particles, take the same step.
    """

    def __init__(self, comm: Comm, parameters: Iterable[nn.Parameter], steps: int, first_rate: float,
                 last_rate: float) -> None:
        self.comm, self.parameters = comm, list(parameters)
        self.steps, self.first_rate, self.last_rate = steps, first_rate, last_rate
        self.taken = 0
        # Running means of the gradient and of its square.
        self._moments = {name: [torch.zeros_like(p) for p in self.parameters]
                         for name in ("exp_avg", "exp_avg_sq")}

    @property
    def learning_rate(self) -> float:
        """Learning rate of the next step."""
        return self.first_rate * (self.last_rate / self.first_rate) ** (self.taken / max(self.steps - 1, 1))

    def step(self, share: Tensor) -> float:
        """Take a step, given this rank's share of the global loss, and return the norm of the global gradient."""
        for parameter in self.parameters:
            parameter.grad = None
        if share.requires_grad:  # otherwise no parameter affects this rank's share
            share.backward()
        # A rank whose share does not depend on a parameter still takes part in the sum.
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in self.parameters]
        on_host = [gradient.cpu() for gradient in gradients]
        sum_flat(self.comm, [gradient.numpy() for gradient in on_host])
        for gradient, summed in zip(gradients, on_host):
            gradient.copy_(summed)
        norm = float(sum(gradient.double().square().sum() for gradient in on_host) ** 0.5)
        steps = [torch.tensor(float(self.taken)) for _ in self.parameters]  # `adam` adds 1 to each
        with torch.no_grad():
            adam(self.parameters, gradients, *self._moments.values(), [], steps, amsgrad=False, beta1=0.9,
                 beta2=0.999, lr=self.learning_rate, weight_decay=0.0, eps=1e-8, maximize=False)
        self.taken += 1
        return norm

    def state_dict(self) -> dict[str, int | np.ndarray]:
        """Return the number of steps taken and the running means, for a checkpoint; they are equal on all ranks."""
        means = {f"{name}_{number}": mean.cpu().numpy() for name, means in self._moments.items()
                 for number, mean in enumerate(means)}
        return {"taken": self.taken, **means}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state from `state_dict`."""
        self.taken = state["taken"]
        for name, means in self._moments.items():
            for number, mean in enumerate(means):
                mean.copy_(torch.from_numpy(state[f"{name}_{number}"]).reshape(mean.shape))


def shared_values(comm: Comm, shares: Mapping[str, Tensor]) -> dict[str, float]:
    """Return, for each name, the sum of the shares of all ranks. One message carries all of them."""
    own = np.array([float(share.detach()) for share in shares.values()])  # shares may be on different devices
    return dict(zip(shares, global_sum(comm, own).tolist()))


@dataclass(frozen=True)
class Phase:
    """A part of a training, with its own decay of the learning rate and its own validation error.

    Parameters
    ----------
    name : name in the progress line.
    work : cost (steps,) of each optimiser step, in a unit that all phases share. The time left is estimated from it.
    rates : learning rate of the first and of the last step.
    take : function of the optimiser and the step's number in the phase. It takes an optimiser step and returns numbers
        by name, among them "loss" and "gradient_norm".
    validate : function that returns the error on held-out data. The phase ends with the state of the model that has the
        smallest error. If `validate` is None, it ends with the last state.
    validate_every : number of steps from one validation to the next; there is also one after the last step.
    patience : the phase ends after this many steps without a smaller validation error. If it is None, all steps are
        taken.
    """

    name: str
    work: np.ndarray
    rates: tuple[float, float]
    take: Callable[[Adam, int], dict[str, float]]
    validate: Callable[[], float] | None = None
    validate_every: int = 1
    patience: int | None = None

    @property
    def steps(self) -> int:
        """Number of optimiser steps."""
        return len(self.work)


class TrainingDiverged(ValueError):
    """A loss or a gradient is not finite, or no validation error of a phase is finite; raised by all ranks."""


class Training:
    """Trains a model in phases, one after the other. Each phase has at least one step.

    A phase with validation ends with the state of the model that has the smallest error. This may be the state before
    the first step. All ranks hold the same state.

    `history` has for each step a row, a dict of numbers. In a phase with validation, the first row has `start_error`,
    the validation error before the step.
    """

    def __init__(self, comm: Comm, model: nn.Module, phases: Sequence[Phase]) -> None:
        self.comm, self.model = comm, model
        self.phases = list(phases)
        self.history: list[dict[str, float]] = []
        self._started, self._seconds_before = time.perf_counter(), 0.0
        self._begin(0)

    def _begin(self, number: int) -> None:
        """Begin the phase of this number, counted from 0."""
        self.phase_number, self.best_error, self.best, self.best_at = number, np.inf, self._weights(), 0
        if self.running:
            self.optimizer = Adam(self.comm, self.model.parameters(), self.phase.steps, *self.phase.rates)

    @property
    def running(self) -> bool:
        """Whether an unfinished phase remains."""
        return self.phase_number < len(self.phases)

    @property
    def phase(self) -> Phase:
        """The current phase."""
        return self.phases[self.phase_number]

    @property
    def steps(self) -> int:
        """Steps taken so far, in all phases."""
        return len(self.history)

    @property
    def seconds(self) -> float:
        """Wall seconds of the training so far, including the time before a restart."""
        return self._seconds_before + time.perf_counter() - self._started

    @property
    def done(self) -> float:
        """Fraction of the work of all phases that is done."""
        before = [phase.work for phase in self.phases[:self.phase_number]]
        done = sum(work.sum() for work in (*before, self.phase.work[:self.optimizer.taken]))
        return float(done / sum(phase.work.sum() for phase in self.phases))

    def step(self) -> None:
        """Take a step of the current phase, and validate if a validation is due."""
        phase, rate = self.phase, self.optimizer.learning_rate
        start = {"start_error": self._error_of(phase.validate)} if phase.validate and self.optimizer.taken == 0 else {}
        row = {"phase": float(self.phase_number), "step": float(self.steps), "learning_rate": rate, **start,
               **phase.take(self.optimizer, self.optimizer.taken)}
        place = f"step {self.steps + 1} of the training ({phase.name})"
        for name in ("loss", "gradient_norm"):
            if not np.isfinite(row[name]):
                raise TrainingDiverged(f"{place}: {name} is {row[name]}, at a learning rate of {rate:.3g}")
        last = self.optimizer.taken == phase.steps
        if phase.validate and (last or self.optimizer.taken % phase.validate_every == 0):
            row["validation_error"] = self._error_of(phase.validate)
            last = last or phase.patience is not None and self.optimizer.taken - self.best_at >= phase.patience
        if phase.validate and last:
            if self.best_error == np.inf:
                raise TrainingDiverged(f"{place}: no validation error of this phase was finite")
            self._load(self.best)
        row["seconds"] = self.seconds
        self.history.append(row)
        if last:
            self._begin(self.phase_number + 1)

    @property
    def cost(self) -> list[dict[str, Any]]:
        """A row for each finished phase, with its name `phase`, its number of `steps`, its `seconds` and its `error`.

        `seconds` is wall time and includes validations. `error` is the validation error of the model at the end of the
        phase; None without validation.
        """
        finished, before = [], 0.0
        for number, phase in enumerate(self.phases[:self.phase_number]):
            rows = [row for row in self.history if row["phase"] == number]
            errors = [row[name] for row in rows for name in ("start_error", "validation_error") if name in row]
            finished.append({"phase": phase.name, "steps": len(rows), "seconds": rows[-1]["seconds"] - before,
                             "error": min(errors, default=None)})
            before = rows[-1]["seconds"]
        return finished

    def columns(self) -> dict[str, np.ndarray]:
        """Return the history as arrays (steps,) by name. They are NaN at steps whose row lacks the name."""
        names = sorted({name for row in self.history for name in row})
        return {name: np.array([row.get(name, np.nan) for row in self.history]) for name in names}

    def state_dict(self) -> dict[str, Any]:
        """Return the whole state of the training, for a checkpoint: numbers and arrays by name."""
        parts = {"model": self._weights(), "best": self.best, "history": self.columns(),
                 "optimizer": self.optimizer.state_dict()}
        return {"number": self.phase_number, "best_error": self.best_error, "best_at": self.best_at,
                "names": {part: list(values) for part, values in parts.items()},
                **{f"{part} {name}": value if isinstance(value, int) else np.atleast_1d(value)
                   for part, values in parts.items() for name, value in values.items()}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state from `state_dict`."""
        parts = {part: {name: state[f"{part} {name}"] for name in names} for part, names in state["names"].items()}
        self._load(parts["model"])
        self._begin(state["number"])
        self.best, self.best_error, self.best_at = parts["best"], state["best_error"], state["best_at"]
        self.optimizer.load_state_dict(parts["optimizer"])
        rows = zip(*parts["history"].values())
        self.history = [{name: float(value) for name, value in zip(parts["history"], row) if value == value}
                        for row in rows]
        self._seconds_before = self.history[-1]["seconds"] if self.history else 0.0

    def _error_of(self, validate: Callable[[], float]) -> float:
        """Return the validation error, and store the state of the model if no earlier error was as small.

        The error is infinite if `validate` raises HaloError or returns a number that is not finite.
        """
        try:
            error = validate()
        except HaloError:
            error = np.inf
        error = error if np.isfinite(error) else np.inf
        if error < self.best_error:
            self.best_error, self.best, self.best_at = error, self._weights(), self.optimizer.taken
        return error

    def _weights(self) -> dict[str, np.ndarray]:
        return {name: tensor.detach().cpu().numpy().copy() for name, tensor in self.model.state_dict().items()}

    def _load(self, weights: Mapping[str, np.ndarray]) -> None:
        shapes = {name: tensor.shape for name, tensor in self.model.state_dict().items()}
        self.model.load_state_dict({name: torch.from_numpy(np.asarray(array)).reshape(shapes[name])
                                    for name, array in weights.items()})
