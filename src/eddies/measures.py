"""The measures by which rollouts are compared with the truth: names and words, in the order of tables and figures."""

#: Zero is perfect, but for the ratios.
MEASURES = {
    "velocity_error_early": "velocity error at t_η",
    "velocity_error_half": "velocity error at T/2",
    "velocity_error_end": "velocity error at the end",
    "spectrum_error": "spectrum error, k ≤ k_d (rms of logarithms)",
    "spectrum_error_floor": "spectrum error of the true tracers",
    "energy_ratio": "energy, model / truth",
    "velocity_kl": "KL velocity",
    "velocity_kl_floor": "KL velocity, two samples of the truth",
    "acceleration_kl": "KL acceleration",
    "acceleration_kl_floor": "KL acceleration, two samples of the truth",
    "qr_kl": "KL Q–R",
    "qr_kl_floor": "KL Q–R, two samples of the truth",
    "acceleration_error": "acceleration error at the start",
    "structure_error": "structure function, rms of logarithms",
    "flatness_error": "flatness of velocity increments, rms of logarithms",
    "acceleration_correlation_error": "autocorrelation of the acceleration, rms difference",
    "acceleration_variance_error": "variance of the acceleration, rms of logarithms",
    "pair_dispersion_error": "pair dispersion, rms of logarithms",
    "tetrad_size_error": "size of tetrads, rms of logarithms",
    "tetrad_shape_error": "shape of tetrads, rms of logarithms",
    "count_variance_ratio": "variance of counts, model / truth",
}
#: Those that the table of variants shows, and of them those that are drawn.
DRAWN = ("velocity_error_early", "velocity_error_half", "spectrum_error", "acceleration_kl")
SHOWN = ("velocity_error_early", "velocity_error_half", "velocity_error_end", "spectrum_error", "energy_ratio",
         "velocity_kl", "velocity_kl_floor", "acceleration_kl", "acceleration_kl_floor", "qr_kl", "qr_kl_floor",
         "acceleration_error")
