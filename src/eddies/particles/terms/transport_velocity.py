"""Particles that move with a transport velocity, which keeps them evenly spread."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from eddies.particles.context import Context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.pairs import CompiledSum, ScaledPairs
from eddies.particles.rates import Rates
from eddies.particles.smoothing_kernels import CubicSpline, over_distance
from eddies.particles.terms.term import Coefficient, PairTerm
from eddies.scene import terms as declared

# p_b delta_t over rho_0 c h at first.
BACKGROUND = 0.25


class TransportVelocity(PairTerm):
    """dx_i/dt = v_i + w_i, w_i the force of a constant background pressure p_b acting for a time delta_t (Adami, Hu &
    Adams 2013), and dv_i/dt by what the velocity is elsewhere:

        w_i = -(p_b delta_t/m) sum_j (V_i^2 + V_j^2) grad W,   V = m/rho
        (w_i.grad) v = sum_j V_j (v_j - v_i) (w_i.grad W)

    p_b delta_t is a parameter in units of rho_0 c h, at first 1/4: a background pressure c^2 rho_0 and the step
    delta_t = h/(4c) of that paper, whatever the step is here; of it the size counts, as particles would gather by a
    negative one. h is half the radius of interaction, which is the support of W. In place of (w.grad) v that paper has
    the divergence of the stress v w, with momentum kept, but a further v div w: particles at random, which w spreads,
    gain and lose velocity by it, more than they would without any term.
    """

    Settings = declared.TransportVelocity
    parity, mutual = torch.tensor([-1.0] * 3 + [1.0] * 9), True

    def __init__(self, settings: declared.TransportVelocity, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        self.kernel, self.mass = CubicSpline(flow.cutoff), flow.particle_mass
        self.unit = flow.scales.density_mean * flow.scales.required("sound_speed") * flow.cutoff / 2
        self.background = nn.Parameter(torch.tensor(BACKGROUND, dtype=torch.float64))

    @property
    def learned_coefficients(self) -> list[Coefficient]:
        """|p_b delta_t|."""
        return [Coefficient.of("|p_b delta_t|", self.background.abs(), "background pressure times the time that it "
                               "acts; learned over rho_0 c h", "M/(L T)", self.unit)]

    def pair_values(self, pairs: ScaledPairs) -> Tensor:
        """-m (1/rho_i^2 + 1/rho_j^2) grad W, and the entries of -m (v_i - v_j) grad W^T/(rho_i rho_j): (12, m)."""
        listed = pairs.pairs
        density = pairs.column("density").to(listed.distance)
        own, other = listed.at_receivers(density), listed.at_senders(density)
        slope = self.mass * over_distance(self.kernel.derivative(listed.distance), listed.distance)
        push = (own**-2 + other**-2) * slope * listed.displacement.T
        gradient = pairs.velocity_difference[:, None] * (slope / (own * other) * listed.displacement.T)
        return -torch.cat([push, gradient.flatten(0, 1)])

    def compiled(self, context: Context) -> CompiledSum:
        """The same for the compiled library."""
        scales, support = context.flow.scales, self.kernel.support
        width = scales.filter_width
        unit = self.mass * width / support**5
        return CompiledSum("transport-velocity", (support / width, unit, unit * scales.velocity),
                           scalars=(context.column("density"),))

    def rates_of(self, sums: Tensor, context: Context) -> Rates:
        """Shift velocity and shift acceleration."""
        shift = self.background.abs() * self.unit * sums[:3]
        carried = context.own_density.to(sums) * (sums[3:].unflatten(0, (3, 3)) * shift).sum(1)
        return Rates(shift_velocity=shift.T.to(context.particles.velocity.dtype),
                     shift_acceleration=carried.T.to(context.particles.velocity.dtype))
