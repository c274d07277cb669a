import numpy as np
import pytest
import torch
from mpi4py import MPI

from eddies.flow.tracers import release
from eddies.learning.kernel_training import KernelSample, KernelTrainer
from eddies.learning.training import Adam
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.particle_field import ParticleField, grid_points
from eddies.particles.smoothing_kernels import CubicSpline, KernelNetwork, integral

LENGTH, CELLS, PER_SIDE = 2 * np.pi, 12, 10
SPACING = LENGTH / PER_SIDE


def flow(x):
    """Velocity (n, 3) and gradient (n, 3, 3) of a smooth flow at points (n, 3)."""
    velocity = torch.stack([torch.sin(2 * x[:, 1]), torch.sin(x[:, 2]), torch.sin(x[:, 0])], dim=1)
    gradient = torch.zeros(len(x), 3, 3, dtype=x.dtype)
    gradient[:, 0, 1] = 2 * torch.cos(2 * x[:, 1])
    gradient[:, 1, 2], gradient[:, 2, 0] = torch.cos(x[:, 2]), torch.cos(x[:, 0])
    return velocity, gradient


def sample_of(comm, support):
    slab = SlabDecomposition(comm, LENGTH, CELLS)
    position = torch.from_numpy(release(slab, 3, PER_SIDE**3, "random")["position"])
    particle_field = ParticleField(slab, support, position, flow(position)[0], torch.float64)
    return KernelSample(particle_field, *flow(grid_points(slab, CELLS)))


def fit(comm, support=2.4 * SPACING, steps=4, rates=(1e-3, 1e-3)):
    sample, network = sample_of(comm, support), KernelNetwork(support, (8, 8), seed=1)
    trainer = KernelTrainer(network, [sample], 1.0, 0.5, 200, seed=2)
    optimizer = Adam(comm, network.parameters(), steps, *rates)
    return sample, network, [trainer.step(optimizer, step) for step in range(steps)]


@pytest.mark.mpi(3)
def test_training_is_the_same_on_any_number_of_ranks(comm):
    _, network, losses = fit(comm)
    _, alone, losses_alone = fit(MPI.COMM_SELF)
    for row, other in zip(losses, losses_alone):
        assert row == pytest.approx(other, rel=1e-10)
    for parameter, other in zip(network.parameters(), alone.parameters()):
        assert torch.allclose(parameter, other, rtol=1e-8, atol=1e-12)


@pytest.mark.mpi(3)
def test_a_zero_field_has_an_error_of_one(comm):
    sample = sample_of(comm, 2.4 * SPACING)
    assert sample.errors_of(0 * sample.field, 0 * sample.gradient) == pytest.approx((1, 1), rel=1e-12)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("spacings", [1.8, 3.0])
def test_the_learned_kernel_beats_a_cubic_spline_of_the_wrong_width(comm, spacings):
    """For this flow the best support of a spline is 2.4 spacings. A spline of that width does as well as the learned
    kernel."""
    support = spacings * SPACING
    sample, network, _ = fit(comm, support, 60, (2e-2, 2e-3))
    with torch.no_grad():
        learned, field = network.table(), sample.particles
        errors = [sample.errors_of(*field.averaged(kernel, field.points))
                  for kernel in (learned, CubicSpline(support))]
    assert float(integral(learned)) == pytest.approx(1, rel=1e-12)
    fitted, spline = (velocity**2 + gradient**2 for velocity, gradient in errors)
    assert fitted < 0.8 * spline
