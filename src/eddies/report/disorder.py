"""Disorder of the particles of a rollout beside that of the true tracers: one figure and its numbers."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from eddies.analysis import disorder
from eddies.analysis.pdfs import kl_divergence
from eddies.analysis.rollout import Rollout
from eddies.measures import MEASURES
from eddies.report.figures import GUIDE, letter, panels, styled
from eddies.report.page import Metric, Section
from eddies.report.rollout_figures import LINES

Series = Mapping[str, Mapping[str, np.ndarray]]  # columns over time of "truth" and "model"


@dataclass(frozen=True)
class Disorder:
    """Shares of nearest-neighbour distances at one time, and series over time, of "truth" and "model".

    distances: (bins,) each, on disorder.DISTANCE_EDGES; counts: columns time, count_variance.
    """

    time: float
    distances: Mapping[str, np.ndarray]
    counts: Series

    @property
    def divergence(self) -> float:
        """Forward KL divergence of the PDFs of nearest-neighbour distances."""
        return kl_divergence(self.distances["truth"], self.distances["model"])

    @classmethod
    def of(cls, run: Rollout) -> "Disorder":
        """Distances at the last common frame, series over all frames before the model broke, if it did."""
        both = {"model": run.model, "truth": run.truth}
        position = run.pair(-1, "position")
        distances = {name: disorder.distance_probabilities(getattr(position, name), run.length) for name in both}
        counts = {name: disorder.count_variance_series(frames, run.before_broken(name), run.length)
                  for name, frames in both.items()}
        return cls(position.time, distances, counts)


def add(shown: Section, run: Rollout) -> None:
    """Put the figure and its numbers, all at the last common time, into the section of the rollout."""
    found, turnover = Disorder.of(run), run.turnover
    kept = disorder.drifts(run)
    shown.metrics += [
        Metric("nearest_distance_kl", "KL divergence of the nearest-neighbour distance PDF", found.divergence),
        *(Metric(key, MEASURES[key], both) for key, both in kept.items()),
    ]
    shown.add_figure(
        "particle-disorder", "Disorder of the particles", draw(found, turnover),
        f"A: distance to the nearest neighbour at t = {found.time / turnover:.2f} T; KL {found.divergence:.2g}. "
        f"B: variance of the particles' number in cells of {disorder.CELL:g} mean spacings, 1 for random points; "
        f"at that time {kept['count_variance']['truth']:.2f} (true tracers), {kept['count_variance']['model']:.2f} "
        "(model): above the truth's the model's particles cluster.")


@styled
def draw(found: Disorder, turnover: float) -> Figure:
    """PDF of nearest-neighbour distances beside that of random points, variance of counts over time."""
    figure, axes = panels(1, 2, (4.0, 3.1))
    edges = disorder.DISTANCE_EDGES
    fine, centres = np.linspace(edges[0], edges[-1], 300), (edges[1:] + edges[:-1]) / 2
    nearest, counts = axes[0]
    nearest.plot(fine, disorder.random_distance_density(fine), color=GUIDE, linestyle=":", label="random points")
    for name, line in LINES.items():
        nearest.plot(centres, found.distances[name] / np.diff(edges), **line)
        counts.plot(found.counts[name]["time"] / turnover, found.counts[name]["count_variance"], **line)
    nearest.set(title="Nearest neighbour", xlabel="distance / mean spacing", ylabel="PDF", ylim=(0, None))
    nearest.legend()
    counts.axhline(1, color=GUIDE, linestyle=":")
    counts.set(title="Variance of counts", ylabel="over that of random points", xlabel="time $t/T$", ylim=(0, None))
    letter(axes.flat)
    return figure
