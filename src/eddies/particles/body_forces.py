"""Forces on particles that do not come from their neighbours."""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

from eddies.parallel.reduction import global_sum
from eddies.particles.particle_set import as_numpy


class LinearForcing:
    """f(x) = A sum_k u(k) exp(ikx) over 0 < |k| < k_f: linear forcing of the large scales.

    u(k) = 1/N sum_j (v_j - <v>) exp(-ikx_j), its solenoidal part; A = `injection_rate` / sum |u(k)|^2, so
    that the mean of f.v over all particles is exactly the rate (Lundgren 2003, with the amplitude set at
    every evaluation). The mean of f is removed, so the total momentum is kept.

    Parameters
    ----------
    injection_rate : energy per mass and time, not negative.
    wavenumber : k_f, in units of the smallest one, 2 pi / length.
    comm : communicator of the ranks that share the particles; one message an evaluation.
    length : side of the box.
    """

    cutoff = 0.0
    reads = ("velocity",)

    def __init__(self, injection_rate: float, wavenumber: float, comm, length: float = 2 * math.pi) -> None:
        if not injection_rate >= 0:
            raise ValueError(f"injection rate {injection_rate}: must not be negative")
        self.injection_rate, self.comm = injection_rate, comm
        reach = range(-math.ceil(wavenumber), math.ceil(wavenumber) + 1)
        # One of each pair k, -k: the other is its conjugate.
        half = [
            k for k in itertools.product(reach, repeat=3) if k > (0, 0, 0) and math.hypot(*k) < wavenumber
        ]
        if not half:
            raise ValueError(f"forcing wavenumber {wavenumber}: it must exceed 1, the smallest one")
        self.wavevectors = torch.tensor(half, dtype=torch.float64) * (2 * math.pi / length)

    def __call__(self, position: Tensor, velocity: Tensor) -> Tensor:
        """Force (n, 3) at this rank's particles; collective.

        It cannot be differentiated: raises RuntimeError if that is asked for.
        Raises ValueError if the forced modes carry no energy that could be amplified.
        """
        if torch.is_grad_enabled() and (position.requires_grad or velocity.requires_grad):
            raise RuntimeError("linear forcing cannot be differentiated: train on unforced flow")
        phase = position @ self.wavevectors.to(position).T
        waves = torch.stack([torch.cos(phase), -torch.sin(phase)])
        modes, structure = self._modes(waves, velocity.to(position.dtype))
        energy = 2 * float((modes * modes).sum())
        if energy == 0 and self.injection_rate > 0:
            raise ValueError("the particles have no energy at the forced wavenumbers")
        amplitude = self.injection_rate / energy if energy > 0 else 0.0
        mean = torch.einsum("ck,ckd->d", structure, modes)
        force = torch.einsum("cnk,ckd->nd", waves, modes) - mean
        return (2 * amplitude * force).to(velocity.dtype)

    def _modes(self, waves: Tensor, velocity: Tensor) -> tuple[Tensor, Tensor]:
        """Solenoidal velocity modes (2, k, 3), particle number modes (2, k): real, imaginary parts."""
        ones = torch.ones_like(velocity[:, :1])
        columns = torch.cat([velocity, ones], dim=1)
        local = torch.cat([torch.einsum("cnk,nd->ckd", waves, columns).flatten(), columns.sum(0)])
        total = torch.as_tensor(global_sum(self.comm, as_numpy(local))).to(velocity)
        modes, mean = total[:-4].reshape(2, -1, 4) / total[-1], total[-4:-1] / total[-1]
        structure = modes[..., 3]
        fluctuation = modes[..., :3] - structure.unsqueeze(-1) * mean
        k = self.wavevectors.to(velocity)
        along = (fluctuation * k).sum(-1, keepdim=True) / (k * k).sum(-1, keepdim=True)
        return fluctuation - along * k, structure
