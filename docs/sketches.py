"""Draws the sketches of how-it-works.md: pipeline.png and particle.png.

    .venv/bin/python docs/sketches.py
"""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch
from pictures import save

from eddies.report.figures import BLUE, GUIDE, MODEL, NOTE, SECOND, styled

HERE = Path(__file__).parent
# Stages: place of the middle in inches, what is done, the command, the product.
STAGES = {
    "dns": (0.9, 1.55, "direct simulation,\nfilter, tracers", "eddies dns", "ground_truth.h5"),
    "kernel": (3.0, 2.85, "smoothing kernel", "eddies train-kernel", "kernel.h5"),
    "train": (3.0, 1.55, "forces from\ntrue paths", "eddies train", "model.h5"),
    "fields": (3.0, 0.45, "fields of tracks", "eddies reconstruct", "reconstruction.h5"),
    "step": (4.85, 1.55, "cheapest\nconverged step", "eddies find-step", "step.h5"),
    "simulate": (4.85, 0.45, "particle simulation", "eddies simulate", "rollout.h5"),
    "report": (6.75, 0.45, "model beside truth", "eddies report", "report/")}
ARROWS = ("dns", "kernel"), ("dns", "train"), ("dns", "fields"), ("train", "step"), ("step", "simulate"), \
    ("simulate", "report")
HALF_WIDTH, HALF_HEIGHT = 0.83, 0.45
SPACING, WIDTH, NEIGHBORS = 1.0, 2.0, 60  # mean spacing, filter width in it, neighbours: the defaults of a scene


def plain_axes(size: tuple[float, float], low: tuple[float, float], high: tuple[float, float]) -> tuple[Figure, Axes]:
    """A figure of this size in inches with one panel without frame, between two corners."""
    figure = Figure(size)
    axes = figure.add_axes((0, 0, 1, 1), xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set_axis_off()
    return figure, axes


@styled
def pipeline() -> Figure:
    """The stages of a run with their commands and products."""
    figure, axes = plain_axes((7.65, 3.5), (0, -0.1), (7.65, 3.4))
    line = {"arrowstyle": "-|>", "color": NOTE, "shrinkA": 1, "shrinkB": 1}
    for x, y, words, command, product in STAGES.values():
        axes.add_patch(FancyBboxPatch((x - HALF_WIDTH, y - HALF_HEIGHT), 2 * HALF_WIDTH, 2 * HALF_HEIGHT, linewidth=1.2,
                                      boxstyle="round,pad=0,rounding_size=0.08", facecolor="white", edgecolor=GUIDE))
        axes.text(x, y + 0.16, words, ha="center", va="center", fontsize=10, linespacing=1.0)
        axes.text(x, y - 0.15, command, ha="center", va="center", fontsize=9, color=BLUE, family="monospace")
        axes.text(x, y - 0.33, product, ha="center", va="center", fontsize=9, color=NOTE)
    for start, end in ARROWS:
        (x0, y0), (x1, y1) = STAGES[start][:2], STAGES[end][:2]
        across = x1 - x0 > HALF_WIDTH
        first = (x0 + HALF_WIDTH, y0 + 0.25 * np.sign(y1 - y0)) if across else (x0, y0 - HALF_HEIGHT)
        last = (x1 - HALF_WIDTH, y1 - 0.25 * np.sign(y1 - y0)) if across else (x1, y1 + HALF_HEIGHT)
        axes.annotate("", last, first, arrowprops=line)
    (x0, y0), (x1, y1) = STAGES["kernel"][:2], STAGES["report"][:2]
    axes.annotate("", (x1, y1 + HALF_HEIGHT), (x0 + HALF_WIDTH, y0),
                  arrowprops={**line, "connectionstyle": "angle,angleA=0,angleB=90,rad=8"})
    axes.text(0.9, 2.45, "a velocity cube starts it,\nmeasured tracks\nreplace it", ha="center", fontsize=9, color=NOTE)
    axes.annotate("", (0.9, 1.55 + HALF_HEIGHT), (0.9, 2.4), arrowprops=line)
    axes.text(4.85, 2.2, "for each variant", ha="center", va="center", fontsize=9, color=NOTE)
    return figure


@styled
def particle() -> Figure:
    """A particle among its neighbours in a slice one spacing thick, with filter width and radius of interaction."""
    radius = (3 * NEIGHBORS / (4 * np.pi)) ** (1 / 3) * SPACING
    figure, axes = plain_axes((7.0, 3.7), (-3.1, -2.8), (7.3, 2.7))
    places = np.random.default_rng(11).uniform((-3, -2.6), (3, 2.6), (31, 2))  # one in each square spacing
    inside = np.hypot(*places.T) < radius
    near = places[(places[:, 0] > 1) & inside & (places[:, 1] < -1)][0]
    shade = np.hypot(*np.meshgrid(*[np.linspace(-radius, radius, 241)] * 2))
    axes.imshow(np.exp(-6 * (shade / WIDTH) ** 2), extent=(-radius, radius) * 2, cmap="Greys", vmax=2.5, zorder=0)
    axes.add_patch(Circle((0, 0), radius, fill=False, linewidth=1.6, color=MODEL))
    axes.scatter(*places[~inside].T, s=20, color=GUIDE)
    axes.scatter(*places[inside].T, s=20, color=MODEL)
    axes.scatter(0, 0, s=50, color="black", zorder=3)
    axes.plot(*zip((0, 0), near), color=BLUE, linewidth=1.4)
    for place, velocity in (((0, 0), (-0.5, 0.75)), (near, (0.55, 0.5))):
        axes.annotate("", np.add(place, velocity), place, arrowprops={"arrowstyle": "-|>", "color": SECOND})
    for width, middle, colour in ((WIDTH, (0, 0), NOTE), (SPACING, (3.8, -2.5), GUIDE)):
        ends = [(middle[0] + side * width / 2, middle[1]) for side in (1, -1)]
        axes.annotate("", *ends, arrowprops={"arrowstyle": "|-|,widthA=0.25,widthB=0.25", "color": colour, "shrinkA": 0,
                                             "shrinkB": 0})
    for place, words, colour in (((-0.7, 0.06), "d", NOTE), ((-1.85, 1.75), "h", MODEL), ((0.6, -0.7), "x", BLUE),
                                 ((-0.75, 0.75), "$v_i$", SECOND), (near + (0.55, 0.6), "$v_j$", SECOND),
                                 ((0.14, 0.1), "i", "black"), (near + (0.1, -0.3), "j", MODEL)):
        axes.text(*place, words, color=colour, fontsize=11, weight="bold")
    for height, colour, words in (
            (2.3, MODEL, "h: radius of interaction,\nwith 60 neighbours inside"),
            (1.2, NOTE, "d: width of the filter (shaded),\nbelow which the velocity is smooth"),
            (0.1, BLUE, "x: separation of a pair, in units of d"),
            (-0.5, SECOND, "v: difference of the velocities,\nin units of their rms u'"),
            (-1.5, "black", "Forces from a resolved velocity\ntake all particles of the box."),
            (-2.36, GUIDE, "                 mean spacing")):
        axes.text(3.3, height, words, color=colour, fontsize=10, va="top")
    return figure


if __name__ == "__main__":
    save(HERE / "pipeline.png", pipeline())
    save(HERE / "particle.png", particle())
