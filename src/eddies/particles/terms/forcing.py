"""Linear forcing of the large scales."""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

from eddies.particles.context import Context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.rank_sums import sum_over_ranks
from eddies.particles.rates import Rates
from eddies.particles.terms import settings as declared
from eddies.particles.terms.term import Term, TermError


class Forcing(Term):
    """f(x) = A sum_k u(k) exp(ikx) over 0 < |k| < k_f: linear forcing of the large scales.

    u(k) = 1/N sum_j (v_j - <v>) exp(-ikx_j), its solenoidal part; A = `injection_rate` / sum |u(k)|^2, so
    that the mean of f.v over all particles is exactly the rate (Lundgren 2003, with the amplitude set at
    every evaluation). The mean of f is removed, so the total momentum is kept. One message an evaluation.
    """

    Settings = declared.Forcing
    settings: declared.Forcing
    linear = True

    def __init__(self, settings: declared.Forcing, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        reach = range(-math.ceil(settings.wavenumber), math.ceil(settings.wavenumber) + 1)
        # One of each pair k, -k: the other is its conjugate.
        half = [k for k in itertools.product(reach, repeat=3)
                if k > (0, 0, 0) and math.hypot(*k) < settings.wavenumber]
        self._half = torch.tensor(half, dtype=torch.float64)

    def forward(self, context: Context) -> Rates:
        """The acceleration. Raises TermError if the forced modes carry no energy that could be amplified."""
        particles, wavevectors = context.particles, self._half * (2 * math.pi / context.decomposition.length)
        wavevectors = wavevectors.to(particles.position)
        phase = particles.position @ wavevectors.T
        waves = torch.stack([torch.cos(phase), -torch.sin(phase)])
        modes, structure = _modes(context, waves, wavevectors)
        energy = 2 * (modes * modes).sum()
        if energy == 0 and self.settings.injection_rate > 0:
            raise TermError("the particles have no energy at the forced wavenumbers that could be amplified; leave "
                            "the forcing out, or let its wavenumber reach to where they move")
        amplitude = self.settings.injection_rate / energy if energy > 0 else 0.0
        mean = torch.einsum("ck,ckd->d", structure, modes)
        force = torch.einsum("cnk,ckd->nd", waves, modes) - mean
        return Rates(acceleration=(2 * amplitude * force).to(particles.velocity.dtype))


def _modes(context: Context, waves: Tensor, wavevectors: Tensor) -> tuple[Tensor, Tensor]:
    """Solenoidal velocity modes (2, k, 3), particle number modes (2, k): real, imaginary parts."""
    velocity = context.particles.velocity.to(waves)
    columns = torch.cat([velocity, torch.ones_like(velocity[:, :1])], dim=1)
    local = torch.cat([torch.einsum("cnk,nd->ckd", waves, columns).flatten(), columns.sum(0)])
    total = sum_over_ranks(context.comm, local)
    modes, mean = total[:-4].reshape(2, -1, 4) / total[-1], total[-4:-1] / total[-1]
    structure = modes[..., 3]
    fluctuation = modes[..., :3] - structure.unsqueeze(-1) * mean
    along = (fluctuation * wavevectors).sum(-1, keepdim=True) / (wavevectors * wavevectors).sum(-1, keepdim=True)
    return fluctuation - along * wavevectors, structure
