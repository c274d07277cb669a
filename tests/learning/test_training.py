import numpy as np
import pytest
import torch
from torch import nn

from eddies.learning.training import Phase, Training, TrainingDiverged
from eddies.parallel.halo import HaloError

TARGET = torch.tensor([[1.0, -2.0, 0.5]], dtype=torch.float64)


def training_of(comm, validate=None, steps=(6, 5), patience=None):
    """A linear map learned from random vectors, drawn for each step, in two phases; ranks share the loss evenly."""
    torch.manual_seed(3)
    model = nn.Linear(3, 1, bias=False).double()

    def take(optimizer, step):
        given = torch.from_numpy(np.random.default_rng([7, step]).standard_normal((4, 3)))
        loss = (model(given) - given @ TARGET.T).square().mean()
        return {"loss": float(loss), "gradient_norm": optimizer.step(loss / comm.size)}

    def error():
        return float((model.weight - TARGET).norm())

    phases = [Phase(f"phase {number}", np.ones(count), (0.1, 0.01), take, validate or error, 2, patience)
              for number, count in enumerate(steps)]
    return Training(comm, model, phases)


def finished(training):
    while training.running:
        training.step()
    return training


def numbers(training):
    """Weights and history, but for the time that was taken."""
    columns = {name: values for name, values in training.columns().items() if name != "seconds"}
    return {"weight": training.model.weight.detach().numpy(), **columns}


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("best, patience", [(None, None), (2, None), (2, 2)],
                         ids=["best at the end", "best after two steps", "of little patience"])
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
def test_the_state_of_least_validation_error_is_kept(comm):
    seen, errors = [], iter([4.0, 3.0, 1.0, 2.0, 8.0, 5.0, 4.0, 6.0])

    def validate():
        seen.append(training.model.weight.detach().numpy().copy())
        return next(errors)

    training = training_of(comm, validate)
    finished(training)
    # A validation at the start and three within each phase: the last but one is the best of both.
    assert np.array_equal(training.model.weight.detach().numpy(), seen[6])
    assert np.array_equal(seen[4], seen[2])  # the second phase begins with the best of the first
    starts = np.flatnonzero(training.columns()["phase"] == 1)
    assert starts[0] == 6


@pytest.mark.mpi(1)
def test_what_each_phase_cost_and_where_it_ended(comm):
    errors = iter([4.0, 3.0, 1.0, 2.0, 8.0, 5.0, 0.5, 6.0])
    training = training_of(comm, lambda: next(errors))
    assert training.cost == []
    finished(training)
    # The first phase begins with an error of 4, the second with one of 8: the least of each is that of what is kept.
    assert [(each["phase"], each["steps"], each["error"]) for each in training.cost] == [
        ("phase 0", 6, 1.0), ("phase 1", 5, 0.5)]
    assert sum(each["seconds"] for each in training.cost) == pytest.approx(training.history[-1]["seconds"])
    assert all(each["seconds"] > 0 for each in training.cost)


@pytest.mark.mpi(1)
def test_a_phase_ends_with_its_patience(comm):
    """Of the first phase the error is least after two steps, looked at every other one; the second is at its best at
    its end."""
    training = training_of(comm, lambda: abs(training.optimizer.taken - 2) if training.number == 0 else
                           10.0 - training.optimizer.taken, steps=(12, 8), patience=4)
    columns = finished(training).columns()
    assert np.bincount(columns["phase"].astype(int)).tolist() == [6, 8]


@pytest.mark.mpi(1)
def test_a_phase_that_only_does_harm_ends_where_it_began(comm):
    errors = iter([1.0, 2.0, 3.0, 4.0])
    training = training_of(comm, lambda: next(errors), steps=(6,))
    start = training.model.weight.detach().numpy().copy()
    assert np.array_equal(finished(training).model.weight.detach().numpy(), start)


@pytest.mark.mpi(1)
def test_without_validation_a_phase_ends_where_its_last_step_led(comm):
    training = training_of(comm)
    seen = []

    def taking(take):
        def taken(optimizer, step):
            row = take(optimizer, step)
            seen.append(training.model.weight.detach().numpy().copy())
            return row
        return taken

    training.phases = [Phase(phase.name, phase.work, phase.rates, taking(phase.take)) for phase in training.phases]
    finished(training)
    assert not {"start_error", "validation_error"} & set(training.columns())
    assert len(seen) == 11 and np.array_equal(training.model.weight.detach().numpy(), seen[-1])


@pytest.mark.mpi(1, 2)
def test_a_loss_that_is_not_finite_ends_the_training_on_all_ranks(comm):
    training = training_of(comm)
    with torch.no_grad():
        training.model.weight[0, 1] = np.inf
    with pytest.raises(TrainingDiverged, match=r"step 0 of the training \(phase 0\): loss is"):
        finished(training)


@pytest.mark.mpi(1)
def test_errors_that_are_no_numbers_are_no_best_and_nothing_else(comm):
    def validate():
        error = next(errors)
        if error is HaloError:
            raise HaloError("too far")
        return error

    errors = iter([HaloError, np.nan, 3.0, HaloError])
    training = finished(training_of(comm, validate, steps=(6,)))
    assert training.best_error == np.inf and not training.running  # of a next phase that there is not
    assert training.columns()["validation_error"][[1, 3, 5]].tolist() == [np.inf, 3.0, np.inf]
    assert training.columns()["start_error"][0] == np.inf
    errors = iter([np.nan] * 4)
    with pytest.raises(TrainingDiverged, match=r"step 5 of the training \(phase 0\): at no time .* finite"):
        finished(training_of(comm, validate, steps=(6,)))


@pytest.mark.mpi(1)
def test_work_done_counts_steps_by_their_cost(comm):
    training = training_of(comm, steps=(2, 2))
    training.phases = [Phase(phase.name, np.array(work), phase.rates, phase.take, phase.validate, 2)
                       for phase, work in zip(training.phases, ([1.0, 1.0], [2.0, 4.0]))]
    found = []
    while training.running:
        found.append(training.done)
        training.step()
    assert found == [0, 1 / 8, 2 / 8, 4 / 8]
