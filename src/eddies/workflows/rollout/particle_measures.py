"""Fields and spectra that one rank computes from particles at one time."""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
import torch

from eddies.analysis.rollout import Frames
from eddies.parallel.communicator import Comm
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.flow_units import ReferenceScales, planes_for
from eddies.particles.particle_field import Form, ParticleField
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.particles.resolved_velocity import ResolvedVelocity

MOST_ITERATIONS = 100  # largest number of iterations in a solve for a spectrum, see ParticleSpectra
GRADIENT = "velocity_gradient"


class ReconstructedFields:
    """A series of velocity fields on a grid, reconstructed from particles by a `Form`.

    It can be read like a `FieldSeries`. The results for the last frame that was read are kept.

    Parameters
    ----------
    slab : the box on one rank. The grid has `slab.planes` points along each axis; point i is at i L / `slab.planes`.
    """

    variables = columns = ("velocity",)

    def __init__(self, particles: Frames, form: Form, slab: SlabDecomposition) -> None:
        self.particles, self.form, self.slab = particles, form, slab
        self.times, self.cells = particles.times, slab.planes
        self._kept: dict[str, tuple[int, Any]] = {}  # by name: frame of the last call, and its result

    def read(self, index: int, variable: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Return the planes start, ..., stop - 1 of a frame, (3, stop - start, y, x)."""
        whole = self._once("velocity", index, lambda: self._by_component(self.form.on_grid(self._field(index)), 3))
        return whole[:, start:stop]

    def gradients(self, frame: int) -> np.ndarray:
        """Return the velocity gradients at the particles, (n, 3, 3) [component, direction]."""
        def made() -> np.ndarray:
            field = self._field(frame)
            return as_numpy(self.form.at(field, field.owned)[1])

        return self._once("gradients", frame, made)

    def plane(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the velocity (3, y, x) and the magnitude of the vorticity (y, x) on the grid in the plane z = pi.

        The velocity is relative to the mean over the particles.
        """
        axis = torch.arange(self.slab.planes, dtype=torch.float64) * self.slab.spacing
        y, x = torch.meshgrid(axis, axis, indexing="ij")
        middle = torch.full_like(x, self.slab.planes // 2 * self.slab.spacing)
        points = torch.stack([x, y, middle], -1).reshape(-1, 3)
        velocity, gradient = self.form.at(self._field(frame), points)
        antisymmetric = gradient - gradient.transpose(1, 2)  # its norm is sqrt(2) times the vorticity
        vorticity = antisymmetric.square().sum((1, 2)).div(2).sqrt()
        velocity = velocity - torch.from_numpy(self.particles.read(frame, "velocity").mean(axis=0)).to(velocity)
        return self._by_component(velocity, 2), as_numpy(vorticity).reshape([self.slab.planes] * 2)

    def _once(self, name: str, frame: int, make: Callable[[], Any]) -> Any:
        if name not in self._kept or self._kept[name][0] != frame:
            self._kept[name] = frame, make()
        return self._kept[name][1]

    def _field(self, frame: int) -> ParticleField:
        def made() -> ParticleField:
            position, velocity = (torch.from_numpy(self.particles.read(frame, name))
                                  for name in ("position", "velocity"))
            return ParticleField(self.slab, self.form.support, position, velocity)

        return self._once("field", frame, made)

    def _by_component(self, velocity: torch.Tensor, dimensions: int) -> np.ndarray:
        return as_numpy(velocity).T.reshape(3, *[self.slab.planes] * dimensions)


class WithGradients:
    """A series of particles with one more column, the reconstructed `velocity_gradient` dv_i/dx_j."""

    def __init__(self, particles: Any, fields: ReconstructedFields) -> None:
        self._particles, self._fields, self.times = particles, fields, particles.times
        self.total, self.length, self.columns = particles.total, particles.length, (*particles.columns, GRADIENT)

    def read(self, frame: int, column: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Read rows start, ..., stop - 1 of a column, in order of id."""
        if column == GRADIENT:
            return self._fields.gradients(frame)[start:stop]
        return self._particles.read(frame, column, start, stop)


class ParticleSpectra:
    """Energy spectra of particles, from the modes that a least-squares fit finds in their velocities.

    The modes are those of `ResolvedVelocity`, as in the closures of the particle model. No kernel attenuates them. The
    wavenumbers are the same for all methods, for model and for truth. Every solve starts from 0 and is in single
    precision, like the stored frames.

    Particles without a force between them cluster and leave voids, where only the weak prior determines the modes. The
    equations become ill-conditioned: after T/2 without a force, a solve takes 167 iterations in the scene `hit` and 121
    in `hit-coarse`, instead of 44. Iterations after the first 100 change ln E(k) by 0.07 at most. This is little, since
    such spectra have twice the true energy. A solve therefore ends after 100 iterations; if it has not converged,
    `complaints` lists it.

    Parameters
    ----------
    scales : scales of the flow. length : edge of the box. alone : a communicator of one rank.
    """

    def __init__(self, scales: ReferenceScales, length: float, alone: Comm) -> None:
        self.scales, self.length, self.alone = scales, length, alone
        self.complaints: list[str] = []

    @cached_property
    def _resolution(self) -> ResolvedVelocity:
        cells = max(planes_for(round((self.length / self.scales.spacing) ** 3)), 3)  # splines need 3
        found = ResolvedVelocity.on_slabs(SlabDecomposition(self.alone, self.length, cells), self.scales,
                                          dtype=torch.float32)
        found.most_iterations = MOST_ITERATIONS
        return found

    def of(self, particles: Frames, frame: int, whose: str) -> np.ndarray:
        """Return E(k) of shell 0 up to the last shell in which all modes are resolved, and of shell 1 in any case.
        `whose` names the particles in `complaints`."""
        position, velocity = (particles.read(frame, name).astype(float) for name in ("position", "velocity"))
        with torch.no_grad():
            flow = self._resolution.of(ParticleSet.from_numpy(
                {"id": np.arange(len(position)), "position": position, "velocity": velocity}))
        if not flow.converged:
            self.complaints.append(
                f"at time {particles.times[frame]:.3g} the solve for the spectrum of the {whose} did not converge in "
                f"{flow.iterations} iterations (residual {flow.residual:.1e}); this spectrum is less accurate, because "
                "particles have clustered and left voids")
        return as_numpy(flow.spectrum[:max(self._resolution.grid.resolved, 2)]).astype(float)
