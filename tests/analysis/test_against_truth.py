"""Statistics of a rollout beside those of its ground truth."""

from types import SimpleNamespace

import numpy as np

from eddies.analysis.against_truth import conditional_flows, particle_series
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


def test_only_particles_with_a_density_have_a_series_of_it():
    columns = {"velocity": np.array([[1.0, 2.0, 2.0], [3.0, 0.0, 0.0]]), "density": np.array([0.9, 1.1])}
    run = SimpleNamespace(times=np.array([0.0, 0.5]), columns=["velocity"],
                          read=lambda frame, column: (frame + 1) * columns[column])
    assert list(particle_series(run, [1])) == ["time", "energy"]
    run.columns.append("density")
    found = particle_series(run, [0, 1])
    assert found["energy"].tolist() == [1.5, 6.0] and np.allclose(found["density_rms"], [0.1, 0.2])
