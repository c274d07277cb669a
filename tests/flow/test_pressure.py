import numpy as np
import pytest

from eddies.flow.pressure import PressureSolver
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.spectral.interpolation import SplineInterpolation
from eddies.spectral.spectral_grid import SpectralGrid

LENGTH, CELLS = 2 * np.pi, 12


def solver_and_points(comm):
    """A solver, with points in and just outside of this rank's slab."""
    slab = SlabDecomposition(comm, LENGTH, CELLS)
    random = np.random.default_rng(comm.rank)
    positions = random.uniform(0, LENGTH, (20 + comm.rank, 3))
    outside = 0.9 * slab.spacing
    positions[:, 2] = random.uniform(slab.lower - outside, slab.upper + outside, len(positions))
    return PressureSolver(slab, resolved=4), positions, random


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("kind", ["cubic", "quintic"])
def test_spreading_is_the_transpose_of_interpolation(comm, kind):
    grid = SpectralGrid(SlabDecomposition(comm, LENGTH, 13))
    spline, random = SplineInterpolation(grid, kind), np.random.default_rng(comm.rank)
    modes = grid.forward(random.standard_normal((2, *grid.physical_shape)))
    positions = random.uniform(0, LENGTH, (15, 3))
    positions[:, 2] = random.uniform(grid.decomposition.lower, grid.decomposition.upper, 15)
    values = random.standard_normal((15, 2))
    found = np.sum(spline.at(spline.coefficients(modes), positions) * values)
    expected = np.sum(grid.backward(modes) * grid.backward(spline.from_coefficients(spline.spread(values, positions))))
    assert global_sum(comm, found) == pytest.approx(global_sum(comm, expected), rel=1e-11)


FACTORS = np.array([0.1, 0.3, -0.2, 0.4])


def methods(solver, name):
    """What a method makes of field and positions, and its adjoint with weights, without derivatives by factors."""
    if name == "force":
        return (lambda field, at: solver.force_at(field, at, FACTORS),
                lambda field, at, weights: solver.force_adjoint(field, at, FACTORS, weights)[:2])
    return getattr(solver, f"{name}_at"), getattr(solver, f"{name}_adjoint")


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("name", ["velocity", "pressure", "force"])
def test_adjoints_against_central_differences_along_random_vectors(comm, name):
    solver, positions, random = solver_and_points(comm)
    values, adjoint = methods(solver, name)
    field, field_change = random.standard_normal((2, len(solver.points), 3))
    position_change = random.standard_normal(positions.shape)
    weights = random.standard_normal(values(field, positions).shape)
    by_field, by_position = adjoint(field, positions, weights)

    def slope(field_change, position_change):
        step = 1e-5
        ends = [values(field + sign * field_change, positions + sign * position_change) for sign in (step, -step)]
        return global_sum(comm, np.sum(weights * (ends[0] - ends[1])) / (2 * step))

    # The error of a central difference is step^2 of the third derivative, and rounding over step.
    assert slope(field_change, 0) == pytest.approx(global_sum(comm, np.sum(by_field * field_change)), rel=1e-7)
    assert slope(0, position_change) == pytest.approx(global_sum(comm, np.sum(by_position * position_change)), rel=1e-6)


@pytest.mark.mpi(1, 2, 3)
def test_energies_by_bands_and_their_adjoint(comm):
    """Of sin y in x (shell 1, band 0) and 2 cos 3z in y (shell 3, band 1): 1/4 and 1."""
    solver, _, random = solver_and_points(comm)
    x, y, z = solver.points.T
    field = np.stack([np.sin(y), 2 * np.cos(3 * z), 0 * x], axis=1)
    assert np.allclose(solver.band_energies(field), [0.25, 1.0], atol=1e-12)
    change, weights = random.standard_normal(field.shape), np.array([1.3, -0.7])
    ends = [weights @ solver.band_energies(field + sign * change) for sign in (1, -1)]
    found = global_sum(comm, np.sum(solver.band_energies_adjoint(field, weights) * change))
    assert found == pytest.approx((ends[0] - ends[1]) / 2, rel=1e-10)  # the energy is quadratic


@pytest.mark.mpi(1, 2)
def test_derivatives_by_the_factors_of_the_force(comm):
    solver, positions, random = solver_and_points(comm)
    field, weights = random.standard_normal((len(solver.points), 3)), random.standard_normal((len(positions), 4))
    found = global_sum(comm, solver.force_adjoint(field, positions, FACTORS, weights)[2])
    for number, unit in enumerate(np.eye(len(FACTORS))):
        ends = [global_sum(comm, np.sum(weights * solver.force_at(field, positions, FACTORS + part)))
                for part in (unit, -unit)]
        assert found[number] == pytest.approx((ends[0] - ends[1]) / 2, rel=1e-10)  # the force is linear in them


@pytest.mark.mpi(1)
@pytest.mark.parametrize("factors", [[0.0, 0.3, 0.0, 0.0, 0.0], [0.0, 0.6, 0.1]])
def test_pressure_and_force_of_a_known_flow(comm, factors):
    """u = (sin y, sin x, 0): lap p = -2 cos x cos y, so p = cos x cos y; wavenumber 1 of 4 is damped at a rate 0.3."""
    solver, positions, _ = solver_and_points(comm)
    x, y, z = solver.points.T
    field = np.stack([np.sin(y), np.sin(x), 0 * z], axis=1)
    found = solver.force_at(field, positions, np.array(factors))
    x, y, z = positions.T
    velocity = np.stack([np.sin(y), np.sin(x), 0 * z], axis=1)
    force = np.stack([np.sin(x) * np.cos(y), np.cos(x) * np.sin(y), 0 * z], axis=1) - 0.3 * velocity
    assert np.abs(found[:, 0] - np.cos(x) * np.cos(y)).max() < 2e-3  # of the splines between 12 points a wave
    assert np.abs(found[:, 1:] - force).max() < 4e-3
    assert np.abs(solver.pressure_at(field, positions)[:, 0] - found[:, 0]).max() < 1e-14


@pytest.mark.mpi(1)
def test_stress_of_the_gradient_model_at_grid_points_by_plain_fourier_transforms(comm):
    cells, resolved = 18, 4  # products are free of aliasing
    solver = PressureSolver(SlabDecomposition(comm, LENGTH, cells), resolved)
    k = np.fft.fftfreq(cells, 1 / cells)
    kz, ky, kx = np.meshgrid(k, k, k, indexing="ij")
    wave = np.stack([kx, ky, kz])
    modes = np.fft.fftn(np.random.default_rng(4).standard_normal((3, cells, cells, cells)), axes=(1, 2, 3))
    modes[:, (wave**2).sum(0) > resolved**2] = 0
    modes -= wave * (wave * modes).sum(0) / np.maximum((wave**2).sum(0), 1)  # solenoidal, as the solver makes it

    def physical(spectral):
        return np.fft.ifftn(spectral, axes=(-3, -2, -1)).real

    slopes = physical(1j * wave[None] * modes[:, None])
    stress = np.fft.fftn(np.einsum("ik...,jk...->ij...", slopes, slopes), axes=(2, 3, 4))
    kept = (np.abs(wave) <= resolved).all(0)  # as the force is represented
    expected = physical(kept * (1j * wave[None] * stress).sum(1)).reshape(3, -1).T
    field = physical(modes).reshape(3, -1).T
    forces = [solver.force_at(field, solver.points, np.array([factor, 0.0, 0.0])) for factor in (0.0, 1.0)]
    assert np.allclose((forces[0] - forces[1])[:, 1:], expected, atol=1e-12 * np.abs(expected).max() * 10)


@pytest.mark.mpi(1)
def test_a_mean_velocity_has_no_influence(comm):
    solver, positions, random = solver_and_points(comm)
    field = random.standard_normal((len(solver.points), 3))  # with a divergence, as particles leave one
    found = solver.force_at(field, positions, FACTORS)
    moved = solver.force_at(field + [30.0, -20.0, 10.0], positions, FACTORS)
    assert np.allclose(found, moved, rtol=0, atol=1e-10)
