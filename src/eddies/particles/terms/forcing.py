"""Linear forcing of the large scales."""

from __future__ import annotations

import torch

from eddies.particles.context import Context
from eddies.particles.rates import Rates
from eddies.particles.terms.term import Term
from eddies.scene import terms as declared
from eddies.scene.terms import TermError


class Forcing(Term):
    """f(k) = A u(k) over 0 < |k| < k_f with A = P / sum |u*(k)|^2: linear forcing of the large scales of the resolved
    velocity u, as the filter leaves it (Lundgren 2003, with the amplitude set at every evaluation).

    The flow is forced by A u*, u* = u / G its velocity before the filter (`flow/forcing.py`): P, the `injection_rate`,
    is the power that this puts into the flow. What it puts into the filtered flow is less, A sum |u(k)|^2.
    """

    Settings = declared.Forcing
    settings: declared.Forcing
    linear = True

    def forward(self, context: Context) -> Rates:
        """Modes of the force. Raises TermError if the forced modes carry no energy that could be amplified."""
        flow, below = context.resolved, self.settings.wavenumber
        square = flow.mean_square(flow.unfiltered, 0, below)
        if square == 0 and self.settings.injection_rate > 0:
            raise TermError("the particles have no energy at the forced wavenumbers that could be amplified; leave "
                            "the forcing out, or let its wavenumber reach to where they move")
        amplitude = self.settings.injection_rate / square if square > 0 else 0.0
        shell = flow.grid.shell
        return Rates(force_modes=amplitude * torch.where((shell > 0) & (shell < below), flow.velocity, 0))
