"""Units of a flow: measured scales that make a model dimensionless, and the size of particles' neighbourhoods."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np

from eddies.errors import UserError
from eddies.parallel.communicator import Comm
from eddies.parallel.reduction import global_sum

# Three upper limits of the highest wavenumber that particles resolve: BEYOND_NYQUIST times their Nyquist wavenumber;
# BEYOND_DISSIPATION / eta, where the spectrum ends; and the wavenumber at which the filter's transfer function falls to
# LEAST_TRANSFER, since the closure divides by this function (docs/methods.md).
BEYOND_NYQUIST, BEYOND_DISSIPATION, LEAST_TRANSFER = 1.5, 1.05, 0.02
#: Number of cells in the shortest wavelength that the grid of the resolved velocity resolves. Cubic splines can
#: represent a wave of this length.
CELLS_PER_WAVENUMBER = 7 / 3
MAY_VANISH = ("viscosity", "kolmogorov_length")
MEAN_DENSITY = 1.0
# Columns that change along a trajectory, and the names of their rates of change.
RATES = {"velocity": "acceleration", "density": "density_rate"}

Columns = Mapping[str, np.ndarray]


class ScaleError(UserError, ValueError):
    """A scale by which a model divides is zero or not finite."""


@dataclass(frozen=True)
class ReferenceScales:
    """Scales of one flow, measured on its filtered ground truth, in the units of the simulation.

    Parameters
    ----------
    filter_width : d of the filter, the unit of length in Eq. 4.
    spacing : mean distance of particles, (box volume / particles)^(1/3).
    velocity : rms of one velocity component about its mean over the particles.
    acceleration : rms of one component of the acceleration along trajectories.
    density_mean : mean density rho_0.
    viscosity : kinematic viscosity nu of the fluid; may be 0.
    density : rms of the density fluctuation rho - rho_0.
    density_rate : rms of the rate of change of density along trajectories.
    sound_speed : speed of sound c.
    kolmogorov_length : Kolmogorov length eta of the flow before the filter, whose spectrum ends near k = 1/eta; 0
        without viscosity.

    Scales of density and sound are None for an incompressible ground truth. A flow at another Mach number supplies its
    own scales to the same network. Raises ScaleError unless all given scales are finite and positive; viscosity and
    kolmogorov_length may be 0.
    """

    filter_width: float
    spacing: float
    velocity: float
    acceleration: float
    density_mean: float
    viscosity: float
    density: float | None = None
    density_rate: float | None = None
    sound_speed: float | None = None
    kolmogorov_length: float = 0.0

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            vanishes = name in MAY_VANISH and value == 0
            if value is not None and not vanishes and not (math.isfinite(value) and value > 0):
                allowed, remedy = (("not negative", "start from another flow ([initial])") if name in MAY_VANISH else
                                   ("positive, because a model divides by it",
                                    "start from a flow that moves and changes ([initial], [forcing])"))
                raise ScaleError(f"reference scale {name} = {value}: must be finite and {allowed}; {remedy}")

    def required(self, name: str) -> float:
        """Return a scale by name. Raises ValueError if it is None, as scales of density and sound may be."""
        value = getattr(self, name)
        if value is None:
            raise ValueError(f"reference scale {name}: a flow without density has none")
        return value

    def to_dict(self) -> dict[str, float | None]:
        return {name: None if value is None else float(value) for name, value in asdict(self).items()}


def resolved_wavenumber(spacing: float, filter_width: float, kolmogorov_length: float) -> float:
    """Return k_c, the highest wavenumber of a filtered velocity that particles with this spacing resolve."""
    highest = min(BEYOND_NYQUIST * math.pi / spacing, math.sqrt(-24 * math.log(LEAST_TRANSFER)) / filter_width)
    return min(highest, BEYOND_DISSIPATION / kolmogorov_length) if kolmogorov_length > 0 else highest


def planes_for(particles: int) -> int:
    """Return the number of cells along each side of the grid of the resolved velocity for a number of particles N:
    1.75 N^(1/3), rounded to even.

    The highest resolved wavenumber is 0.75 N^(1/3). This is 1.5 times the Nyquist wavenumber N^(1/3) / 2 of the
    particles. Each rank holds the particles of a slab of the cube, and a slab consists of whole planes of this grid.
    """
    return 2 * round(0.75 / 2 * CELLS_PER_WAVENUMBER * round(math.cbrt(particles), 9))


def resolved_shells(spacing: float, filter_width: float, kolmogorov_length: float, length: float, planes: int) -> int:
    """Return k_c in units of the smallest wavenumber, rounded down, on a grid of a cube of side `length` with so many
    planes. The result is at least 1."""
    highest = resolved_wavenumber(spacing, filter_width, kolmogorov_length)
    return min(max(int(highest * length / (2 * math.pi) + 1e-9), 1), (planes - 1) // 2)


def allowed_step(angle: float, highest: float, speed: float) -> float:
    """Return the longest time step for velocities resolved up to a wavenumber k_c = `highest`; infinite at rest.

    `speed` is the rms u' of a velocity component. In a step dt, a particle with this velocity crosses the phase
    `angle` = k_c u' dt, in radians, of a wave with the wavenumber k_c.
    """
    return angle / (highest * speed) if speed > 0 else math.inf


@dataclass(frozen=True)
class FlowUnits:
    """Scales of a flow, which make terms dimensionless, and the size of the neighbourhoods of its particles.

    Parameters
    ----------
    scales : measured at the start of the flow.
    cutoff : h, the radius of interaction of pairs.
    neighbors : n, the expected number of particles within this radius.
    seed : seed of the initial parameters.
    """

    scales: ReferenceScales
    cutoff: float
    neighbors: float
    seed: int = 1

    @property
    def particle_mass(self) -> float:
        """Mass of the fluid over the number of particles."""
        return self.scales.density_mean * self.scales.spacing**3


def measured_scales(comm: Comm, at: Columns, after: Columns, interval: float) -> dict[str, float]:
    """Measure the rms of velocity, density and their rates of change over all particles; collective.

    The rms of a vector is that of one component. Returns "velocity_rms" (about the mean over the particles) and
    "density_rms" (about MEAN_DENSITY) in the frame `at`. Returns also "acceleration_rms" and "density_rate_rms", the
    rms of the change from `at` to the frame `after`, divided by `interval`, the time between the two frames. Both
    frames are this rank's rows of `velocity` (n, 3) and, optionally, `density` (n,), of the same particles.
    """
    scales = {}
    for name, rate in RATES.items():
        if name in at:
            mean = MEAN_DENSITY if name == "density" else _mean(comm, at[name])
            scales[f"{name}_rms"] = _rms(comm, at[name] - mean)
            scales[f"{rate}_rms"] = _rms(comm, (after[name] - at[name]) / interval)
    return scales


def _mean(comm: Comm, rows: np.ndarray) -> np.ndarray:
    *total, count = global_sum(comm, np.append(rows.sum(axis=0, dtype=float), len(rows)))
    return np.array(total) / count


def _rms(comm: Comm, values: np.ndarray) -> float:
    square, count = global_sum(comm, np.array([np.sum(values**2), values.size]))
    return float(np.sqrt(square / count))
