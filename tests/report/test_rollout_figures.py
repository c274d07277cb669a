"""Figures of a rollout with few particles or frames."""

import numpy as np
import pytest

from eddies.analysis.against_truth import InvariantStatistics
from eddies.analysis.rollout import Plane
from eddies.analysis.velocity_gradients import ConditionalVelocity, Invariants
from eddies.report.figures import png
from eddies.report.rollout_figures import invariant_plane, velocity_planes


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
