"""Losses and optimiser: values, gradients, and the same results on any number of ranks."""

import numpy as np
import pytest
import torch
from mpi4py import MPI

from eddies.learning.losses import kullback_leibler, mean_square_share, soft_histogram
from eddies.learning.training import Adam


def my_share(comm, whole):
    """This rank's rows of an array; the last of three ranks has none."""
    owners = min(comm.size, 2)
    return whole[np.arange(len(whole)) % owners == comm.rank] if comm.rank < owners else whole[:0]


@pytest.mark.mpi(3)
def test_histogram_and_gradient_are_those_of_one_rank(comm):
    values = 2 * np.random.default_rng(2).standard_normal((200, 3))
    truth = torch.full((11,), 1 / 11, dtype=torch.float64)

    def divergence(own, communicator):
        own = torch.tensor(own, requires_grad=True)
        histogram = soft_histogram(communicator, own, 11, 3.0)
        (kullback_leibler(truth, histogram) / communicator.size).backward()
        return histogram.detach(), own.grad.numpy()

    histogram, gradient = divergence(my_share(comm, values), comm)
    alone, whole_gradient = divergence(values, MPI.COMM_SELF)
    assert float(histogram.sum()) == pytest.approx(1, rel=1e-13)
    assert torch.allclose(histogram, alone, rtol=1e-12)
    assert np.allclose(gradient, my_share(comm, whole_gradient), rtol=1e-11, atol=1e-16)
    # Values beyond the ends have no gradient, as moving them changes nothing.
    assert np.all(whole_gradient[np.abs(values) > 3] == 0)
    spoiled = torch.tensor([torch.nan if comm.rank == 0 else 0.5])
    assert soft_histogram(comm, spoiled, 11, 3.0).isnan().all()


@pytest.mark.mpi(1)
def test_gradient_of_the_histogram_against_finite_differences(comm):
    values = torch.tensor(np.random.default_rng(3).uniform(-2, 2, 40), requires_grad=True)
    truth = torch.full((7,), 1 / 7, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda v: kullback_leibler(truth, soft_histogram(comm, v, 7, 2.5)), values)


def test_divergence_of_known_histograms():
    p = torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64)
    assert float(kullback_leibler(p, p)) == 0
    assert float(kullback_leibler(p, p.flip(0))) == pytest.approx(0.1 * np.log(1.5), rel=1e-4)
    truth, predicted = (torch.tensor(values, dtype=torch.float64) for values in ([0.8, 0.1, 0.1], [0.4, 0.4, 0.2]))
    assert float(kullback_leibler(truth, predicted)) == pytest.approx(0.6 * np.log(2) - 0.1 * np.log(2), rel=1e-4)


@pytest.mark.mpi(2, 3)
def test_adam_takes_the_same_steps_on_any_number_of_ranks(comm):
    target = np.random.default_rng(4).standard_normal((60, 2))

    def fit(rows, communicator):
        parameter = torch.nn.Parameter(torch.zeros(2, dtype=torch.float64))
        unused = torch.nn.Parameter(torch.ones(1, dtype=torch.float64))
        optimizer = Adam(communicator, [parameter, unused], 10, 0.1, 0.01)
        norms = [optimizer.step(mean_square_share(parameter - torch.from_numpy(rows), 1.0, 60)) for _ in range(10)]
        assert float(unused.detach()) == 1 and optimizer.learning_rate == pytest.approx(0.01 * 0.1 ** (1 / 9))
        return parameter.detach().numpy(), norms

    (found, norms), (alone, norms_alone) = fit(my_share(comm, target), comm), fit(target, MPI.COMM_SELF)
    assert np.allclose(found, alone, rtol=1e-12) and norms == pytest.approx(norms_alone, rel=1e-12)
    assert norms[0] == pytest.approx(np.linalg.norm(target.mean(axis=0)))  # of sum_c (p_c - t_c)^2 / 2 at p = 0
