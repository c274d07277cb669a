"""Phases of a training: the best state, patience, restart, divergence."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from eddies.learning.training import Phase, Training, TrainingDiverged
from eddies.parallel.halo import HaloError

TARGET = torch.tensor([[1.0, -2.0, 0.5]], dtype=torch.float64)


def training_of(comm, validate=None, steps=(6, 5), patience=None):
    """A linear map learned from random vectors, drawn for each step, in phases; ranks share the loss evenly."""
    torch.manual_seed(3)
    model = nn.Linear(3, 1, bias=False).double()

    def take(optimizer, step):
        given = torch.from_numpy(np.random.default_rng([7, step]).standard_normal((4, 3)))
        loss = (model(given) - given @ TARGET.T).square().mean()
        return {"loss": float(loss), "gradient_norm": optimizer.step(loss / comm.size)}

    def error():
        return float((model.weight - TARGET).norm())

    return Training(comm, model, [Phase(f"phase {number}", np.ones(count), (0.1, 0.01), take, validate or error, 2,
                                        patience) for number, count in enumerate(steps)])


def weight(training):
    return training.model.weight.detach().numpy().copy()


def finished(training):
    while training.running:
        training.step()
    return training


def numbers(training):
    """Weights and history without the seconds."""
    columns = {name: values for name, values in training.columns().items() if name != "seconds"}
    return {"weight": weight(training), **columns}


@pytest.mark.mpi(2)
@pytest.mark.parametrize("best, patience", [(None, None), (2, 3)], ids=["best at the end", "of little patience"])
def test_a_training_restored_at_any_step_is_bitwise_the_one_never_stopped(comm, best, patience):
    def begun():
        training = training_of(comm, best and (lambda: abs(training.optimizer.taken - best)), patience=patience)
        return training

    whole = numbers(finished(begun()))
    for split in range(len(whole["step"])):
        first, second = begun(), begun()
        for _ in range(split):
            first.step()
        second.load_state_dict(first.state_dict())
        again = numbers(finished(second))
        assert whole.keys() == again.keys()
        for name, values in whole.items():
            assert np.array_equal(values, again[name], equal_nan=True), (split, name)


@pytest.mark.mpi(1)
def test_each_phase_ends_with_its_best_state(comm):
    """A validation at the start of each phase and three within: the last but one is the best."""
    seen, errors = [], iter([4.0, 3.0, 1.0, 2.0, 8.0, 5.0, 0.5, 6.0])

    def validate():
        seen.append(weight(training))
        return next(errors)

    training = training_of(comm, validate)
    assert training.cost == []
    finished(training)
    assert np.array_equal(weight(training), seen[6]) and np.array_equal(seen[4], seen[2])
    assert np.flatnonzero(training.columns()["phase"] == 1)[0] == 6
    assert [(each["phase"], each["steps"], each["error"]) for each in training.cost] == [
        ("phase 0", 6, 1.0), ("phase 1", 5, 0.5)]
    assert sum(each["seconds"] for each in training.cost) == pytest.approx(training.history[-1]["seconds"])
    # The start counts too.
    errors = iter([1.0, 2.0, 3.0, 4.0])
    training = training_of(comm, validate, steps=(6,))
    start = weight(training)
    assert np.array_equal(weight(finished(training)), start)


@pytest.mark.mpi(1)
def test_a_phase_ends_with_its_patience(comm):
    """The first phase has its least error after two steps, the second at its end."""
    training = training_of(comm, lambda: abs(training.optimizer.taken - 2) if training.phase_number == 0 else
                           10.0 - training.optimizer.taken, steps=(12, 8), patience=4)
    assert np.bincount(finished(training).columns()["phase"].astype(int)).tolist() == [6, 8]


@pytest.mark.mpi(1)
def test_a_phase_without_validation_ends_with_its_last_state(comm):
    training, plain = training_of(comm, steps=(6,)), training_of(comm, lambda: -plain.optimizer.taken, steps=(6,))
    training.phases = [replace(phase, validate=None) for phase in training.phases]
    assert np.array_equal(weight(finished(training)), weight(finished(plain)))  # whose last state is its best
    assert not {"start_error", "validation_error"} & set(training.columns())
    assert training.cost[0]["error"] is None


@pytest.mark.mpi(1)
def test_validation_errors_that_are_not_finite_are_never_the_best(comm):
    def validate():
        error = next(errors)
        if error is HaloError:
            raise HaloError("too far")
        return error

    errors = iter([HaloError, np.nan, 3.0, HaloError])
    training = finished(training_of(comm, validate, steps=(6,)))
    assert training.columns()["validation_error"][[1, 3, 5]].tolist() == [np.inf, 3.0, np.inf]
    assert training.columns()["start_error"][0] == np.inf and training.cost[0]["error"] == 3.0
    errors = iter([np.nan] * 4)
    with pytest.raises(TrainingDiverged, match="step 6 .*phase 0.*finite"):
        finished(training_of(comm, validate, steps=(6,)))


@pytest.mark.mpi(1)
def test_the_share_of_work_done_counts_steps_by_their_cost(comm):
    training = training_of(comm, steps=(2, 2))
    training.phases = [replace(phase, work=np.array(work))
                       for phase, work in zip(training.phases, ([1.0, 1.0], [2.0, 4.0]))]
    done = []
    while training.running:
        done.append(training.done)
        training.step()
    assert done == [0, 1 / 8, 2 / 8, 4 / 8]
