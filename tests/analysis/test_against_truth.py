"""Statistics of a rollout beside those of its ground truth."""

from types import SimpleNamespace

import numpy as np

from eddies.analysis.against_truth import conditional_flows
from eddies.analysis.velocity_gradients import InvariantBins, Invariants


def flows_of(amplitude):
    """Mean motion of a model, whose gradients are `amplitude` times the true ones, and of the truth."""
    random = np.random.default_rng(5)
    gradients = random.normal(size=(2, 2000, 3, 3)) * [[[[1.0]]], [[[2.0]]]]
    samples = [(Invariants.of(amplitude * gradient), Invariants.of(gradient)) for gradient in gradients]
    run = SimpleNamespace(common=SimpleNamespace(times=np.array([0.0, 0.1])), invariants=None,
                          both=lambda _, index: samples[index])
    edges = np.linspace(-3, 3, 7)
    return conditional_flows(run, InvariantBins(edges, edges))


def test_the_mean_motion_of_the_invariants_is_in_units_of_the_truth():
    equal, weak = flows_of(1.0), flows_of(0.5)
    assert np.array_equal(equal[0].count, equal[1].count) and np.array_equal(weak[1].second_rate, equal[1].second_rate)
    assert weak[0].count[2:4, 2:4].sum() > 2 * equal[0].count[2:4, 2:4].sum()  # a weaker model is nearer to the origin
