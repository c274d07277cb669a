"""Build the flow of a scene: the fluid on its grid, the choice of its time step, and its initial state."""

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from eddies.flow.stability import CourantLimit, FixedStep
from eddies.flow.forcing import LinearForcing
from eddies.flow.initial_fields import INITIAL_FLOWS, balanced_density, sound_wave_density, velocity_of_spectrum
from eddies.flow.navier_stokes import FLUIDS, Fluid
from eddies.import_path import is_path, load, users_code
from eddies.io.errors import ProductError
from eddies.io.flow_states import StoredStates, VelocityCubes, open_states, read_spectrum
from eddies.parallel.broadcast import on_all_ranks, on_first_rank
from eddies.parallel.communicator import Comm
from eddies.parallel.slab import SlabDecomposition
from eddies.scene.rules import quoted
from eddies.scene.scene import BOX_LENGTH, Flow, Forcing, Initial, SceneError, Time
from eddies.spectral.spectral_grid import SpectralGrid, regrid

log = logging.getLogger("eddies")

MOST_REMOVED = 0.05  # share of energy in the part with divergence above which another code's flow gives a warning


def build_fluid(flow: Flow, forcing: Forcing | None, comm: Comm) -> Fluid:
    """Build the fluid of [flow] on its grid, with the forcing of [forcing]."""
    grid = SpectralGrid(SlabDecomposition(comm, BOX_LENGTH, flow.cells), flow.precision)
    forced = LinearForcing(grid, forcing.injection_rate, forcing.wavenumber) if forcing is not None else None
    kind = load(flow.fluid) if is_path(flow.fluid) else FLUIDS[flow.fluid]
    hint = f'; [flow] fluid = "{flow.fluid}" is called with (grid, viscosity, sound_speed, forcing)'
    with users_code(kind, SceneError, hint):
        return kind(grid, flow.viscosity, flow.sound_speed if flow.compressible else math.inf, forced)


def build_step_limit(time: Time, flow: Flow, grid: SpectralGrid) -> CourantLimit | FixedStep:
    """Return the limit of the time step: a fixed step, or the Courant number. The speed of sound counts only for an
    explicit stepper."""
    if time.step is not None:
        return FixedStep(time.step)
    explicit_sound = flow.sound_speed if time.explicit and flow.compressible else 0.0
    return CourantLimit(grid, time.courant, time.max_step, explicit_sound)


def initial_state(initial: Initial, seed: int, fluid: Fluid) -> np.ndarray:
    """Return the modes of the initial state: the velocity and, for a compressible fluid, s = ln(rho / rho_0)."""
    grid = fluid.grid
    if initial.flow.from_file:
        return _state_from_file(initial, fluid)
    if is_path(initial.kind):
        velocity = _velocity_of_user(initial, seed, grid)
    elif initial.kind == "spectrum":
        velocity = velocity_of_spectrum(grid, seed, *given_spectrum(initial, grid.decomposition.comm))
    else:
        velocity = INITIAL_FLOWS[initial.kind](grid, initial, seed)
    if not fluid.compressible:
        return velocity
    if initial.flow.sound:
        density = sound_wave_density(grid, initial.amplitude, initial.wavenumber)
    else:
        density = balanced_density(grid, velocity, fluid.sound_speed)
    return np.concatenate([velocity, density[None]])


def _velocity_of_user(initial: Initial, seed: int, grid: SpectralGrid) -> np.ndarray:
    """Return the solenoidal part of the velocity that a function of the user returns. Raises SceneError for a wrong
    shape."""
    shape = (3, *grid.spectral_shape)
    function = load(initial.kind)
    with users_code(function, SceneError, f'; [initial] kind = "{initial.kind}" is called with (grid, initial, seed)'):
        velocity = function(grid, initial, seed)
    if not isinstance(velocity, np.ndarray) or velocity.shape != shape:
        returned = f"an array {velocity.shape}" if isinstance(velocity, np.ndarray) else f"a {type(velocity).__name__}"
        raise SceneError(f'[initial] kind = "{initial.kind}": returned {returned}; must be the modes (3, kz, ky, kx) = '
                         f"{shape} of the velocity on this rank, such as grid.forward(velocity) gives")
    return grid.solenoidal(velocity.astype(grid.complex))


def given_spectrum(initial: Initial, comm: Comm) -> tuple[np.ndarray, np.ndarray]:
    """Read the wavenumbers and E(k) from the file of [initial] path; all ranks call it. Raises SceneError if it cannot
    be used."""
    try:
        return on_first_rank(comm, lambda: read_spectrum(initial.file))
    except ProductError as error:
        raise SceneError(f"[initial] path = {quoted(initial.path)}: {error}") from None


@contextmanager
def stored_states(initial: Initial, comm: Comm) -> Iterator[StoredStates | VelocityCubes]:
    """Open the file of unfiltered flow states from which a scene starts; all ranks call it.

    Raises SceneError if no state in the file has the number that [initial] state gives. Raises ProductError if the file
    holds no states.
    """
    with open_states(comm, initial.file) as states:
        if initial.state >= len(states):
            raise SceneError(f"[initial] state = {initial.state}: {initial.path} holds {len(states)} states of the "
                             f"whole flow, with the numbers 0 to {len(states) - 1}; give one of these")
        yield states


def _state_from_file(initial: Initial, fluid: Fluid) -> np.ndarray:
    grid = fluid.grid
    comm, length = grid.decomposition.comm, grid.decomposition.length
    with stored_states(initial, comm) as fields:
        whole = SpectralGrid(SlabDecomposition(comm, length, fields.cells), grid.precision, (fields.cells - 1) // 2)
        planes = (whole.decomposition.start, whole.decomposition.stop)
        names = fields.variables if fluid.compressible else ("velocity",)
        stored = on_all_ranks(comm, lambda: {name: fields.read(initial.state, name, *planes) for name in names},
                              ProductError)
        stored_speed = on_all_ranks(comm, lambda: fields.sound_speed, ProductError)
        foreign = isinstance(fields, VelocityCubes)
        if foreign:
            fields.check(comm, initial.state, stored["velocity"])
    velocity = regrid(whole, grid, whole.forward(stored["velocity"]))
    if "density" in stored:
        density = regrid(whole, grid, whole.forward(np.log(stored["density"])))
        if stored_speed not in (None, fluid.sound_speed):
            # The same density would mean another pressure. A pressure out of balance with the velocity becomes sound.
            density *= (stored_speed / fluid.sound_speed) ** 2
            if comm.rank == 0:
                log.info("dns: the flow in the file has the sound speed %g; fluctuations of ln(density) are "
                         "multiplied by %.3g to keep the pressure", stored_speed,
                         (stored_speed / fluid.sound_speed) ** 2)
        return np.concatenate([velocity, density])
    # A velocity from a compressible flow, from single precision or from fewer points is not exactly solenoidal.
    solenoidal = grid.solenoidal(velocity)
    if foreign:
        kept, all_of_it = (grid.sum_modes(np.square(np.abs(part)).sum(axis=0)) for part in (solenoidal, velocity))
        removed = max(1 - kept / all_of_it, 0.0) if all_of_it else 0.0
        log.info("dns: the velocity in %s has %.3g %% of its energy in a part with divergence, which is removed",
                 initial.path, 100 * removed)
        if removed > MOST_REMOVED and comm.rank == 0:
            log.warning("[initial] path = %s: %.0f %% of the energy is in a part with divergence: the flow may be "
                        "compressible, its axes or components may be in another order than [z, y, x] and u, v, w, or "
                        "its points may be too few for its smallest eddies", quoted(initial.path), 100 * removed)
    if not fluid.compressible:
        return solenoidal
    return np.concatenate([solenoidal, balanced_density(grid, solenoidal, fluid.sound_speed)[None]])
