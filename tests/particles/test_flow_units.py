from dataclasses import replace

import numpy as np
import pytest

from eddies.particles.flow_units import FlowUnits, measured_scales
from eddies.scene.terms import TermError
from tests.particles.configurations import CUTOFF, NEIGHBORS, SCALES, model


@pytest.mark.mpi(1, 2)
def test_measured_scales_are_root_mean_squares_over_all_ranks(comm):
    random = np.random.default_rng(4)
    velocity, density = 0.5 + random.normal(size=(2, 10, 3)), 1 + 0.01 * random.normal(size=(2, 10))
    own = slice(comm.rank * 3, 3 if comm.rank < comm.size - 1 else None)
    frames = [{"velocity": velocity[frame][own], "density": density[frame][own]} for frame in (0, 1)]

    def rms(values):
        return pytest.approx(np.sqrt(np.mean(values**2)), rel=1e-12)

    assert measured_scales(comm, *frames, 0.1) == {
        "velocity_rms": rms(velocity[0] - velocity[0].mean(axis=0)),
        "acceleration_rms": rms((velocity[1] - velocity[0]) / 0.1),
        "density_rms": rms(density[0] - 1), "density_rate_rms": rms((density[1] - density[0]) / 0.1)}


@pytest.mark.parametrize("name, value, message", [
    ("velocity", 0.0, r"velocity = 0\.0: .* positive, .* moves and changes"),
    ("velocity", float("nan"), r"velocity = nan: .* positive"),
    ("viscosity", -1.0, r"viscosity = -1\.0: .* not negative; start from another flow \(\[initial\]\)$")])
def test_an_impossible_scale_is_refused(name, value, message):
    with pytest.raises(ValueError, match=message):
        replace(SCALES, **{name: value})


def test_a_term_that_needs_a_scale_of_the_density_says_so():
    incompressible = replace(SCALES, density=None, density_rate=None, sound_speed=None)
    with pytest.raises(TermError, match='term "wcsph": .*sound_speed'):
        model({"density-flux": {}, "wcsph": {}}, FlowUnits(incompressible, CUTOFF, NEIGHBORS))
