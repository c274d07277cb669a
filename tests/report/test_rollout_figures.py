"""Figures of a rollout with few particles or frames."""

import numpy as np
import pytest

from eddies.analysis.against_truth import InvariantStatistics
from eddies.analysis.rollout import Plane
from eddies.analysis.velocity_gradients import ConditionalVelocity, Invariants
from eddies.report.figures import png
from eddies.report.rollout_figures import errors_over_time, invariant_plane, velocity_planes


@pytest.mark.parametrize("particles", [8, 27, 64, 1000])
def test_invariants_of_few_particles_are_drawn(particles):
    rng = np.random.default_rng(1)
    truth, model, later = (Invariants.of(rng.normal(size=(particles, 3, 3))) for _ in range(3))
    statistics = InvariantStatistics.of(model, truth)
    flows = tuple(ConditionalVelocity(statistics.bins.coarser()) for _ in range(2))
    for flow, before in zip(flows, (model, truth)):
        flow.add(before, later, 0.1, truth.scale)
    for below in (None, flows):
        figure = invariant_plane(statistics, below)
        assert png(figure).startswith(b"\x89PNG")
        assert len(figure.axes[0].collections[0].levels) >= 2


@pytest.mark.parametrize("frames", [1, 2, 4])
def test_planes_are_as_large_with_few_frames(frames):
    plane = Plane(np.random.default_rng(2).normal(size=(3, 8, 8)), np.zeros((8, 8)))
    figure = velocity_planes({"true tracers": [plane] * frames, "model": [plane] * frames}, 0.1 * np.arange(frames))
    png(figure)
    width = figure.axes[0].get_position().width * figure.get_figwidth()
    assert width == pytest.approx(2.05, abs=0.06)


def test_the_density_is_drawn_if_model_and_truth_have_one():
    time = np.arange(3.0)
    without = {"time": time, "energy": time + 1}
    dense = without | {"density_rms": time}
    errors = dict.fromkeys(("time", "velocity_error", "no_force", "velocity_kl", "acceleration_kl"), time)
    for model, truth, panels in ((dense, dense, 4), (dense, without, 3), (without, dense, 3)):
        titles = [axis.get_title(loc="left")[4:] for axis in errors_over_time(model, truth, errors, 1.0).axes]
        assert titles == ["Kinetic energy", "Velocity error", "PDF divergence", "Density fluctuation"][:panels]
