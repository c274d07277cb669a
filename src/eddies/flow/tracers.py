"""Tracers: fluid particles that follow the filtered velocity of a simulation."""

import math

import numpy as np

from eddies.parallel.migration import id_block, migrate, wrap
from eddies.parallel.slab import SlabDecomposition
from eddies.spectral.interpolation import SplineInterpolation
from eddies.spectral.mode_operators import gaussian_transfer
from eddies.spectral.spectral_grid import SpectralGrid


def random_positions(seed: int, total: int, start: int, stop: int, length: float) -> np.ndarray:
    """Return uniformly random positions (stop - start, 3), in [0, length), of the ids start ... stop - 1.

    The position of a particle depends only on `seed`, `total` and its id, not on the number of ranks.
    """
    # Philox yields four 64-bit numbers per counter value; each particle takes one counter value.
    generator = np.random.Generator(np.random.Philox(key=[seed, total]).advance(start))
    return length * generator.random((stop - start, 4))[:, :3]


def lattice_positions(seed: int, per_side: int, start: int, stop: int, length: float) -> np.ndarray:
    """Return positions (stop - start, 3) of the ids start ... stop - 1, near the points of a lattice.

    The lattice has `per_side` points along each axis. Each coordinate is displaced at random by up to 1/4 cell.
    """
    ids = np.arange(start, stop)
    cell = length / per_side
    corner = np.stack([ids % per_side, ids // per_side % per_side, ids // per_side**2], axis=1)
    jitter = random_positions(seed, per_side**3, start, stop, 1.0) - 0.5
    return wrap((corner + 0.5 + 0.5 * jitter) * cell, length)


def release(decomposition: SlabDecomposition, seed: int, total: int, placement: str) -> dict[str, np.ndarray]:
    """Return `id` and `position` of those of `total` new particles that lie in this rank's slab; collective.

    `placement` is "random" or "lattice"; for a lattice, `total` is the cube of an integer.
    """
    start, stop = id_block(decomposition.comm, total)
    if placement == "random":
        positions = random_positions(seed, total, start, stop, decomposition.length)
    else:
        positions = lattice_positions(seed, round(math.cbrt(total)), start, stop, decomposition.length)
    return migrate(decomposition, {"id": np.arange(start, stop, dtype=np.int64), "position": positions})


class FilteredField:
    """Gaussian-filtered velocity at arbitrary points, and in a compressible flow also the filtered density.

    A `filter_width` of 0 means no filter. `interpolation` is the `kind` of SplineInterpolation. Points may lie in this
    rank's slab or in the `margin` planes on each side of it. So a particle may cross at most `margin` planes in a step.
    """

    def __init__(self, grid: SpectralGrid, filter_width: float, interpolation: str, margin: int = 1) -> None:
        self.grid = grid
        self.transfer = gaussian_transfer(grid.wavenumber_squared, filter_width).astype(grid.real)
        self.spline = SplineInterpolation(grid, interpolation, margin)

    def velocity_coefficients(self, state: np.ndarray) -> list[np.ndarray]:
        """Return the spline coefficients of the filtered velocity."""
        return self.spline.coefficients(self.transfer * state[:3])

    def density_modes(self, state: np.ndarray) -> np.ndarray:
        """Return the modes (1, kz, ky, kx) of the filtered density exp(s)."""
        return self.transfer * self.grid.forward(np.exp(self.grid.backward(state[3:])))


class TracerParticles:
    """Particles that move with the filtered velocity v, dx/dt = v(x, t), by Heun's method of second order.

    `columns` holds `id`, `position` and `velocity` of this rank's particles. `velocity` is v at the particles. If it is
    not given, it is computed from `state`, the modes of the flow.
    """

    def __init__(self, field: FilteredField, columns: dict[str, np.ndarray], state: np.ndarray) -> None:
        self.field = field
        self.decomposition = field.grid.decomposition
        self.columns = columns
        if "velocity" not in columns:
            velocity = field.spline.at(field.velocity_coefficients(state), columns["position"])
            self.columns = {**columns, "velocity": velocity}

    def advance(self, state: np.ndarray, step: float) -> None:
        """Advance the particles by a time step; `state` is the flow at the end of the step. Collective."""
        coefficients = self.field.velocity_coefficients(state)
        position, velocity = self.columns["position"], self.columns["velocity"]
        predicted = position + step * velocity
        position = position + step / 2 * (velocity + self.field.spline.at(coefficients, predicted))
        velocity = self.field.spline.at(coefficients, position)
        self.columns = migrate(self.decomposition, {**self.columns, "position": position, "velocity": velocity})

    def density(self, state: np.ndarray) -> np.ndarray:
        """Return the filtered density (n,) at the particles of a compressible flow."""
        coefficients = self.field.spline.coefficients(self.field.density_modes(state))
        return self.field.spline.at(coefficients, self.columns["position"])[:, 0]
