"""The measures that compare rollouts with the truth: key and title, in the order of tables and figures."""

import math
from typing import Any

#: The best value of a measure is 0; for ratios and for the variance of counts it is 1.
MEASURES = {
    "velocity_error_early": "velocity error at t_η",
    "velocity_error_half": "velocity error at T/2",
    "velocity_error_end": "velocity error at the end",
    "spectrum_error": "spectrum error, k ≤ k_d (rms of logarithms)",
    "spectrum_error_floor": "spectrum error of the true tracers",
    "energy_ratio": "energy, model / truth",
    "velocity_kl": "KL velocity",
    "velocity_kl_floor": "KL velocity of two samples of the truth",
    "acceleration_kl": "KL acceleration",
    "acceleration_kl_floor": "KL acceleration of two samples of the truth",
    "qr_kl": "KL Q–R",
    "qr_kl_floor": "KL Q–R of two samples of the truth",
    "acceleration_error": "acceleration error at the start",
    "structure_error": "structure function, rms of logarithms",
    "flatness_error": "flatness of velocity increments, rms of logarithms",
    "acceleration_correlation_error": "autocorrelation of the acceleration, rms difference",
    "acceleration_variance_error": "variance of the acceleration, rms of logarithms",
    "pair_dispersion_error": "pair dispersion, rms of logarithms",
    "tetrad_size_error": "size of tetrads, rms of logarithms",
    "tetrad_shape_error": "shape of tetrads, rms of logarithms",
    "momentum_drift": "drift of the momentum / (N u')",
    "momentum_drift_floor": "drift of the momentum of the true tracers",
    "density_drift": "relative drift of the mean density",
    "density_drift_floor": "relative drift of the mean density of the true tracers",
    "count_variance": "variance of counts / that of random points",
    "count_variance_floor": "variance of counts of the true tracers",
}
#: Measures in the figure of error against run time.
DRAWN = ("velocity_error_early", "velocity_error_half", "spectrum_error", "acceleration_kl")


def finite(value: Any) -> Any:
    """Return the value, or None for a float that is not finite."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
