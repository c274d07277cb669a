"""Names beside the points of a scatter plot, placed so that they cover neither each other nor a point."""

from collections.abc import Sequence
from itertools import product

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Annotation, Text
from matplotlib.transforms import Bbox

# Where a label may stand beside its point: the direction in degrees, best first, and the distance in points.
DIRECTIONS = (0, 180, 45, -45, 135, -135, 90, -90, 20, -20, 160, -160, 70, -70, 110, -110)
DISTANCES = (7, 13, 20, 29, 40, 53, 68, 85)
LEADER_FROM = 12  # points: a label farther away is tied to its point by a thin line
MARKER = 5  # half the width of a marker, in points


def fix_layout(figure: Figure) -> None:
    """Lay the figure out once and for all, so that places in pixels stay what they are."""
    FigureCanvasAgg(figure)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")


def place_labels(axis: Axes, points: np.ndarray, labels: Sequence[str], bold: Sequence[bool]) -> list[Bbox]:
    """Write each label beside its point and return the boxes that they fill, in pixels.

    points: (n, 2) in pixels, of a figure whose layout is fixed. Points in a crowd are named first; each takes the place
    that covers least, the nearest if several cover nothing.
    """
    scale = axis.figure.dpi / 72
    taken = [Bbox.from_extents(*(point - MARKER * scale), *(point + MARKER * scale)) for point in points]
    gaps = np.linalg.norm(points[:, None] - points[None], axis=-1)
    crowded = np.argsort(np.sort(gaps, axis=1)[:, 1:4].sum(axis=1))
    for index in crowded:
        taken.append(_place(axis, points[index], labels[index], bold[index], taken))
    boxes = taken[len(points):]
    return [boxes[position] for position in np.argsort(crowded)]


def _place(axis: Axes, point: np.ndarray, label: str, bold: bool, taken: Sequence[Bbox]) -> Bbox:
    best, best_box, least = None, None, np.inf
    for distance, direction in product(DISTANCES, DIRECTIONS):
        written = _write(axis, point, label, bold, distance, direction)
        written.update_positions(axis.figure.canvas.get_renderer())
        box = Text.get_window_extent(written).padded(1.5)  # of an annotation it would hold the line as well
        covered = sum(_overlap(box, other) for other in taken) + _outside(box, axis.bbox)
        if covered < least:
            if best is not None:
                best.remove()
            best, best_box, least = written, box, covered
        else:
            written.remove()
        if least == 0:
            break
    return best_box


def _write(axis: Axes, point: np.ndarray, label: str, bold: bool, distance: float, direction: float) -> Annotation:
    x, y = np.cos(np.radians(direction)), np.sin(np.radians(direction))
    leader = {"arrowstyle": "-", "color": "#8a8a8a", "linewidth": 0.6, "shrinkA": 0, "shrinkB": 3}
    return axis.annotate(
        label, point, xycoords="figure pixels", xytext=(distance * x, distance * y), textcoords="offset points",
        ha="left" if x > 0.3 else "right" if x < -0.3 else "center",
        va="bottom" if y > 0.6 else "top" if y < -0.6 else "center", fontsize=8.5,
        fontweight="bold" if bold else "normal", arrowprops=leader if distance > LEADER_FROM else None,
        path_effects=[patheffects.withStroke(linewidth=2, foreground="white")], zorder=5, annotation_clip=False)


def _overlap(one: Bbox, other: Bbox) -> float:
    width = min(one.x1, other.x1) - max(one.x0, other.x0)
    height = min(one.y1, other.y1) - max(one.y0, other.y0)
    return width * height if width > 0 and height > 0 else 0.0


def _outside(box: Bbox, frame: Bbox) -> float:
    return box.width * box.height - _overlap(box, frame)
