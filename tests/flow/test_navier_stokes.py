import numpy as np
import pytest

from eddies.clock import Clock
from eddies.errors import UserError
from eddies.flow import initial_fields
from eddies.flow.forcing import LinearForcing
from eddies.flow.history import FlowHistory
from eddies.flow.navier_stokes import CompressibleFluid, IncompressibleFluid
from eddies.flow.stability import quadratic_energy
from eddies.flow.statistics import component_energies, compressible_budget, gradient_moments, turbulence_scales
from eddies.spectral.mode_operators import gaussian_transfer
from eddies.time_stepping import ETDRK4
from tests.validation.flows import make_grid, march, turbulence


@pytest.fixture
def forced(comm):
    """A forced compressible fluid and a state."""
    return turbulence(comm, 16, rate=0.5)


def largest(array):
    return np.abs(array).max(initial=0)


@pytest.mark.mpi(2)
def test_nonlinear_terms_against_derivatives_in_physical_space(comm):
    fluid, state = turbulence(comm, 16)
    grid, nu = fluid.grid, fluid.viscosity
    # The start is solenoidal; a gradient is added to the velocity, so that terms with the dilatation count as well.
    state[:3] += grid.gradient(state[3])
    derivative = [[grid.backward((1j * k * component)[None])[0] for k in grid.wavevector] for component in state]
    u, A, G = grid.backward(state[:3]), np.array(derivative[:3]), np.array(derivative[3])
    S = (A + A.transpose(1, 0, 2, 3, 4)) / 2
    dilatation = np.einsum("iizyx->zyx", A)
    strain_term = np.einsum("ijzyx,jzyx->izyx", S, G) - dilatation * G / 3
    rate_u = -np.einsum("jzyx,ijzyx->izyx", u, A) + 2 * nu * strain_term
    rate_s = -np.einsum("jzyx,jzyx->zyx", u, G)
    expected = grid.forward(np.concatenate([rate_u, rate_s[None]]))
    assert largest(fluid.nonlinear(state) - expected) < 1e-14


@pytest.mark.mpi(1)
def test_linear_function_is_the_exponential_of_the_linear_operator(comm):
    fluid, state = turbulence(comm, 16, c=3.0)
    step, series, term = 0.02, state.copy(), state
    for n in range(1, 40):
        term = step / n * fluid.linear(term)
        series = series + term
    assert largest(fluid.combine((fluid.linear_function(np.exp, step), state)) - series) < 1e-13


@pytest.mark.mpi(1)
def test_incompressible_flow_stays_solenoidal_and_single_precision_follows(comm):
    ends = {}
    for precision, most in (("float64", 1e-15), ("float32", 1e-6)):
        grid = make_grid(comm, 16, precision)
        fluid = IncompressibleFluid(grid, 0.02, forcing=LinearForcing(grid, 0.5, 2.0))
        end = ends[precision] = march(fluid, initial_fields.random_velocity(grid, 3, 1.0, 2.0), 0.02, 10)
        assert end.dtype == grid.complex and largest(grid.divergence(end)) < most
    assert largest(ends["float32"] - ends["float64"]) < 1e-5


@pytest.mark.mpi(2)
@pytest.mark.parametrize("rate, tolerance", [(None, 3e-4), (0.5, 3e-3)])
def test_energy_budget_closes(comm, rate, tolerance):
    # The energy with the density in it is no quadratic invariant, so truncation keeps it only as far as the flow is
    # resolved. The injected power is that of a fluid of density 1; the true one differs by M_t^2, here 0.05.
    fluid, state = turbulence(comm, 24, rate=rate)
    history, clock, advance = FlowHistory(fluid, every=1), Clock(0.1), ETDRK4(fluid)
    history.sample(state, clock)
    while clock.running:
        state = advance(state, 0.01)
        clock.tick(0.01)
        history(state, clock)
    assert history.budget_error < tolerance
    row = history.rows[-1]
    assert row["dissipation_rate"] > 0 and row["turnovers"] > 0 and row["time_step"] == pytest.approx(0.01)
    restored = FlowHistory(fluid)
    restored.load_state_dict(history.state_dict())
    assert restored.rows == history.rows and restored.budget_error == history.budget_error


@pytest.mark.mpi(1)
def test_the_seconds_of_a_step_exclude_what_is_left_out(comm, monkeypatch):
    """Two steps in 5 s, of which 3 s are for something else."""
    now, (fluid, state) = [100.0], turbulence(comm, 8)
    monkeypatch.setattr("eddies.flow.history.time.perf_counter", lambda: now[0])
    history, clock = FlowHistory(fluid), Clock()
    history.sample(state, clock)
    now[0] += 5
    history.leave_out(3.0)
    clock.tick(0.1)
    clock.tick(0.1)
    assert history.sample(state, clock)["seconds_per_step"] == 1


@pytest.mark.mpi(2)
def test_forcing_injects_its_rate_and_none_of_it_at_zero_amplitude(comm, forced):
    fluid, state = forced
    force = np.zeros_like(state[:3])
    fluid.forcing.add(state[:3], force)
    injected = fluid.grid.sum_modes((state[:3].conj() * force).real.sum(axis=0))
    assert injected == pytest.approx(0.5, rel=1e-12)
    silent = CompressibleFluid(fluid.grid, 0.05, 8.0, LinearForcing(fluid.grid, 0.0, 2.0))
    without = CompressibleFluid(fluid.grid, 0.05, 8.0)
    assert np.array_equal(march(silent, state, 0.02, 2), march(without, state, 0.02, 2))


@pytest.mark.mpi(2)
def test_a_filtered_flow_gets_the_filtered_force(comm, forced):
    fluid, state = forced
    grid, width = fluid.grid, 0.8
    transfer = gaussian_transfer(grid.wavenumber_squared, width)
    force, filtered = np.zeros_like(state[:3]), np.zeros_like(state[:3])
    fluid.forcing.add(state[:3], force)
    LinearForcing(grid, 0.5, 2.0, width).add(transfer * state[:3], filtered)
    assert largest(filtered - transfer * force) < 1e-15


@pytest.mark.mpi(1)
def test_forcing_does_not_amplify_what_no_real_field_has(comm):
    # A part in the plane kx = 0 that is not conjugate to its mirror image is invisible in physical space, so only
    # viscosity acts on it. Round-off creates such a part; linear forcing of it would grow without bound.
    grid = make_grid(comm, 12)
    nu, seed, step, count = 0.01, 1e-9, 0.05, 20
    fluid = IncompressibleFluid(grid, nu, forcing=LinearForcing(grid, 1.0, 2.0))
    state = initial_fields.random_velocity(grid, 3, 1.0, 1.5)
    state[0, 1, 0, 0] += seed  # u_x at kz = 1; its mirror image lacks half of it
    state = march(fluid, state, step, count)
    invisible = largest(grid.forward(grid.backward(state)) - state)
    assert invisible == pytest.approx(seed / 2 * np.exp(-nu * step * count), rel=1e-6)


@pytest.mark.mpi(2)
def test_a_flow_without_energy_at_the_forced_modes_is_refused(comm):
    grid = make_grid(comm, 16, "float32")
    velocity = initial_fields.taylor_green(grid, 1.0)
    with pytest.raises(UserError, match="wavenumber = 1.5"):
        LinearForcing(grid, 0.5, 1.5).add(velocity, np.zeros_like(velocity))
    LinearForcing(grid, 0.5, 2.0).add(velocity, np.zeros_like(velocity))
    LinearForcing(grid, 0.0, 1.5).add(velocity, np.zeros_like(velocity))


@pytest.mark.mpi(2)
def test_dissipation_and_gradient_moments_against_all_nine_gradients(comm, forced):
    fluid, state = forced
    grid = fluid.grid
    A = np.array([grid.backward(grid.gradient(component)) for component in state[:3]])
    rho, S = np.exp(grid.backward(state[3:])[0]), (A + A.transpose(1, 0, 2, 3, 4)) / 2
    friction = rho * (2 * (S**2).sum(axis=(0, 1)) - 2 / 3 * np.einsum("iizyx->zyx", A) ** 2)
    budget = compressible_budget(grid, state, 0.05, 8.0)
    assert budget["dissipation_rate"] == pytest.approx(0.05 * float(grid.mean(friction[None])[0]), rel=1e-12)
    diagonal = np.array([A[i, i] for i in range(3)])
    second, third, fourth = (grid.mean(diagonal**power) for power in (2, 3, 4))
    expected = np.mean(third / second**1.5), np.mean(fourth / second**2)
    assert (budget["skewness"], budget["flatness"]) == pytest.approx(expected, rel=1e-10)
    assert gradient_moments(grid, state[:3]) == pytest.approx(expected, rel=1e-10)
    energies = 0.5 * grid.mean(grid.backward(state[:3]) ** 2)
    assert list(component_energies(grid, state[:3]).values()) == pytest.approx(energies, rel=1e-12)


def test_scales_satisfy_the_relations_of_isotropic_turbulence():
    """With all energy at k = 2: L = 3 pi / (4 k), Re_lambda = E (20 / (3 nu eps))^(1/2), eps = nu / t_eta^2."""
    energy, eps, nu, spectrum = 0.6, 0.3, 0.02, np.zeros(9)
    spectrum[2] = energy
    scales = turbulence_scales(spectrum, eps, nu, cutoff=8)
    assert scales["integral_scale"] == pytest.approx(3 * np.pi / 8)
    assert 1.5 * (scales["integral_scale"] / scales["eddy_turnover_time"]) ** 2 == pytest.approx(energy)
    assert scales["reynolds_lambda"] == pytest.approx(energy * np.sqrt(20 / (3 * nu * eps)))
    assert nu / scales["kolmogorov_time"] ** 2 == pytest.approx(eps)
    assert scales["kmax_eta"] ** 2 == pytest.approx(64 * nu * scales["kolmogorov_time"])
    assert turbulence_scales(spectrum, 0.0, 0.0, cutoff=8)["reynolds_lambda"] == np.inf


@pytest.mark.mpi(2)
def test_a_mean_velocity_changes_neither_statistics_nor_forcing(comm):
    """A wind of 1e5 times the velocity; the sums of its modes with others leave round-off of 1e-6."""
    fluid, state = turbulence(comm, 16, rate=0.5)
    moving = state.copy()
    moving[:3] += np.array([1e5, -2e5, 5e4])[:, None, None, None] * (fluid.grid.index_squared == 0)
    rows, forces = [], []
    for each in (state, moving):
        rows.append(FlowHistory(fluid).sample(each, Clock()))
        forces.append(np.zeros_like(each[:3]))
        LinearForcing(fluid.grid, 0.5, 1.5).add(each[:3], forces[-1])
    assert np.array_equal(*forces) and quadratic_energy(fluid, moving) == pytest.approx(quadratic_energy(fluid, state))
    for name in rows[0].keys() - {"total_energy", "seconds_per_step", "surplus_load"}:
        assert rows[1][name] == pytest.approx(rows[0][name], rel=1e-5, abs=1e-12), name
