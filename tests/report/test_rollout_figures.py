"""Figures of rollouts with few particles or frames, and of several variants."""

import numpy as np
import pytest

from eddies.analysis.against_truth import InvariantStatistics
from eddies.analysis.velocity_gradients import ConditionalVelocity, Invariants
from eddies.report.figures import png
from eddies.report.rollout_figures import Drawn, errors_over_time, invariant_planes, row_at, velocity_planes
from eddies.report.rollouts import with_same_truth

NUMBERS = {"attributes": {"eddy_turnover_time": 1.0, "start_time": 0.0}, "truth": "an id"}


def drawn(label, tables, **numbers):
    return Drawn(label, ("#D55E00", "o"), {**NUMBERS, **numbers}, tables)


@pytest.mark.parametrize("particles", [8, 27, 64, 1000])
def test_invariants_of_few_particles_are_drawn(particles):
    rng = np.random.default_rng(1)
    truth, model, later = (Invariants.of(rng.normal(size=(particles, 3, 3))) for _ in range(3))
    found = InvariantStatistics.of(model, truth)
    invariants = {"second": found.bins.second, "third": found.bins.third, "model": found.model, "truth": found.truth}
    flows = {of: ConditionalVelocity(found.bins.coarser()) for of in ("model", "truth")}
    for flow, before in zip(flows.values(), (model, truth)):
        flow.add(before, later, 0.1, truth.scale)
    rates = {"second": flows["model"].bins.second, "third": flows["model"].bins.third,
             **{f"{name}_{of}": getattr(flow, name) for of, flow in flows.items() for name in flow.SUMS}}
    for tables in ({"invariants": invariants}, {"invariants": invariants, "invariant_rates": rates}):
        figure = invariant_planes({"one": drawn("one", tables), "two": drawn("two", tables)})
        assert png(figure).startswith(b"\x89PNG")
        assert len(figure.axes[0].collections[0].levels) >= 2 and len(figure.axes) == 4 * len(tables)


@pytest.mark.parametrize("frames", [1, 2, 4])
def test_planes_are_as_large_with_few_frames(frames):
    """Each variant has a row; the second one ends after its first frame."""
    planes = np.random.default_rng(2).normal(size=(frames, 3, 8, 8))
    whole = {"time": 0.1 * np.arange(frames), "velocity_truth": planes, "velocity_model": planes}
    short = {name: values[:1] for name, values in whole.items()}
    figure = velocity_planes({"whole": drawn("whole", {"planes": whole}), "short": drawn("short", {"planes": short})})
    png(figure)
    width = figure.axes[0].get_position().width * figure.get_figwidth()
    assert width == pytest.approx(2.0, abs=0.05)  # inches; the colour bar has room in any case
    assert [len(axis.images) for axis in figure.axes[:3 * frames]] == [1] * (2 * frames + 1) + [0] * (frames - 1)
    assert row_at(short, 0.0) == 0 and row_at(whole, 0.1 * frames) is None


def test_the_density_is_drawn_if_model_and_truth_have_one():
    time = np.arange(3.0)
    without = {"time": time, "energy": time + 1}
    dense = without | {"density_rms": time}
    errors = {**dict.fromkeys(("velocity_error", "no_force", "velocity_kl", "acceleration_kl"), time + 1), "time": time}
    for model, truth, lines in ((dense, dense, 2), (without, dense, 1), (dense, without, 0)):
        figure = errors_over_time({"one": drawn("one", {"model": model, "truth": truth, "errors": errors})})
        found = [axis for axis in figure.axes if axis.get_title(loc="left").endswith("Density fluctuation")]
        assert sum(len(axis.lines) for axis in found) == lines and len(figure.axes) == 4 + bool(lines)


def test_variants_of_another_truth_are_not_drawn_beside_the_first():
    variants = {"a": drawn("a", {}), "b": drawn("b", {}, truth="another id"), "c": drawn("c", {})}
    assert [*with_same_truth(variants)] == ["a", "c"]
