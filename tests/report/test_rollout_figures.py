"""Figures of rollouts with few particles or frames, and of several variants."""

import numpy as np
import pytest

from eddies.analysis.pdfs import bin_centres
from eddies.analysis.velocity_gradients import InvariantBins
from eddies.report.figures import Variant, png
from eddies.report.rollout_figures import (energy_spectra, errors_over_time, invariant_planes, row_at, velocity_planes,
                                           vorticity_and_energy)

NUMBERS = {"attributes": {"eddy_turnover_time": 1.0}}


def drawn(label, tables):
    return Variant(label, ("#D55E00", "o"), NUMBERS, tables)


@pytest.mark.parametrize("particles", [8, 27, 1000])
def test_invariants_of_few_particles_are_drawn(particles):
    """Also if no cell has enough of them for a mean motion."""
    rng = np.random.default_rng(1)
    planes = {of: rng.normal(size=(2, particles)) for of in ("model", "truth")}
    bins = InvariantBins.covering(*planes["truth"])
    centres = {"second": bin_centres(bins.second), "third": bin_centres(bins.third)}
    invariants = centres | {of: bins.density(bins.probabilities(*plane)) for of, plane in planes.items()}
    rate = rng.normal(size=invariants["truth"].shape) * (1 if particles == 1000 else np.nan)
    rates = centres | {f"{name}_rate_{of}": rate for name in ("second", "third") for of in planes}
    for tables in ({"invariants": invariants}, {"invariants": invariants, "invariant_rates": rates}):
        figure = invariant_planes([drawn("one", tables), drawn("two", tables)])
        assert png(figure).startswith(b"\x89PNG")
        assert len(figure.axes[0].collections[0].levels) >= 2 and len(figure.axes) == 4 * len(tables)


@pytest.mark.parametrize("frames", [1, 2, 4])
def test_planes_are_as_large_with_few_frames(frames):
    """Each variant has a row, and each frame after the start a column; the second variant ends at the start."""
    planes = np.random.default_rng(2).normal(size=(frames, 8, 8))
    whole = {"time": 0.1 * np.arange(frames), "u_x_truth": planes, "u_x_model": planes}
    short = {name: values[:1] for name, values in whole.items()}
    figure = velocity_planes([drawn("whole", {"planes": whole}), drawn("short", {"planes": short})])
    png(figure)
    width = figure.axes[0].get_position().width * figure.get_figwidth()
    assert width == pytest.approx(2.0, abs=0.05)  # inches; the colour bar has room in any case
    columns = max(1, frames - 1)
    assert [len(axis.images) for axis in figure.axes[:3 * columns]] == [1] * 2 * columns + [int(frames == 1)] * columns
    assert figure.axes[columns - 1].get_title() == f"$t = {0.1 * (frames - 1):.2f}\\,T$"
    assert row_at(short, 0.0) == 0 and row_at(whole, 0.1 * frames) is None


def texts(axis):
    return [text.get_text() for text in axis.texts]


def test_planes_have_their_errors_and_a_scale_that_holds_all_models():
    """The model has three times the values of the truth."""
    planes = {"time": np.zeros(1), **{f"{name}_truth": np.ones((1, 8, 8)) for name in ("u_x", "vorticity", "energy")}}
    planes |= {name.replace("truth", "model"): 3 * values for name, values in planes.items() if name != "time"}
    shown = [drawn("large", {"planes": planes})]
    assert [texts(axis) for axis in velocity_planes(shown).axes[:2]] == [[], ["2.00"]]
    *panels, _, _ = vorticity_and_energy(shown).axes
    assert [texts(axis) for axis in panels] == [[], ["2.00"], [], ["2.00"]]
    assert {axis.images[0].norm.vmax for axis in panels} == {3.0}


def test_spectra_have_ratios_to_the_true_tracers_below():
    shells = np.arange(9.0)
    spectra = {"time": np.zeros(1), "energy_truth": np.exp(-shells)[None], "energy_model": 1.5 * np.exp(-shells)[None]}
    flow = {"wavenumber": shells, "energy_flow": np.exp(-shells)[None], "energy_filtered": np.exp(-shells)[None]}
    numbers = NUMBERS | {"filter_width": 0.5}
    figure = energy_spectra([Variant("one", ("#D55E00", "o"), numbers, {"spectra": spectra, "flow_spectra": flow})])
    truth, model = [line.get_ydata() for line in figure.axes[1].lines[:2]]
    assert truth == pytest.approx(np.ones(8)) and model == pytest.approx(np.full(8, 1.5))


def test_the_density_is_drawn_if_model_and_truth_have_one():
    time = np.arange(3.0)
    without = {"time": time, "energy": time + 1}
    dense = without | {"density_rms": time}
    errors = {**dict.fromkeys(("velocity_error", "no_force", "velocity_kl", "acceleration_kl"), time + 1), "time": time}
    for model, truth, lines in ((dense, dense, 2), (without, dense, 1), (dense, without, 0)):
        figure = errors_over_time([drawn("one", {"model": model, "truth": truth, "errors": errors})])
        found = [axis for axis in figure.axes if axis.get_title(loc="left").endswith("Density fluctuation")]
        assert sum(len(axis.lines) for axis in found) == lines and len(figure.axes) == 4 + bool(lines)
