"""Disorder and conservation: distances and counts of particles, and drifts of their momentum and mean density.

Randomly placed particles that follow a solenoidal flow stay randomly placed. The particles of a model may cluster, line
up or oscillate.
"""

import numpy as np

from eddies.analysis.lagrangian import evenly, search_tree
from eddies.analysis.pdfs import bin_probabilities
from eddies.analysis.rollout import Rollout

# Edges of the bins for distances to the nearest neighbour, in mean spacings. Of random points, only a share exp(-14)
# has a larger distance.
DISTANCE_EDGES = np.linspace(0, 1.5, 31)
SAMPLED = 2**15  # largest number of particles whose nearest neighbour is searched
# Largest product of two numbers: the particles whose nearest neighbour is searched, and the particles in the fullest
# cubic cell with the mean spacing as side. This limits the work if particles cluster.
PAIRS = 2**22
CELL = 2.0  # side of the cells in which particles are counted, in mean spacings: about a filter width


def mean_spacing(total: int, length: float) -> float:
    return length / total ** (1 / 3)


def nearest_distances(position: np.ndarray, length: float) -> np.ndarray:
    """Return the distance to the nearest other particle for at most SAMPLED particles: (n, 3) -> (m,).

    These particles are evenly spread over the rows of `position`. The box is periodic with edge `length`. The distance
    is infinite for a single particle.
    """
    crowd = _counts(position, length, round(len(position) ** (1 / 3))).max()
    tree, chosen = search_tree(position, length), evenly(len(position), min(SAMPLED, max(PAIRS // crowd, 1)))
    return tree.query(tree.data[chosen], 2)[0][:, 1]


def distance_probabilities(position: np.ndarray, length: float) -> np.ndarray:
    """Return the share of nearest-neighbour distances in each bin of DISTANCE_EDGES: (n, 3) -> (bins,).

    Raises ValueError if n < 2.
    """
    return bin_probabilities(nearest_distances(position, length) / mean_spacing(len(position), length),
                             DISTANCE_EDGES)


def random_distance_density(distance: np.ndarray) -> np.ndarray:
    """Return the PDF 4 pi r^2 exp(-4/3 pi r^3) of the nearest-neighbour distance r of random points (Hertz 1909).

    r is in mean spacings.
    """
    return 4 * np.pi * distance**2 * np.exp(-4 / 3 * np.pi * distance**3)


def count_variance(position: np.ndarray, length: float) -> float:
    """Return the variance of the number of particles in a cell, divided by that of random points.

    Cells have a side of CELL mean spacings. `position` is (n, 3). Counts of random points are multinomial: their
    variance is the mean times 1 - 1/cells. So the result is 0 for a lattice, 1 to within sqrt(2 / cells) for random
    points, and above 1 for clusters. It is NaN if there are fewer than two cells along a side of the box.
    """
    side = round(len(position) ** (1 / 3) / CELL)
    if side < 2:
        return np.nan
    counts = _counts(position, length, side)
    return float(np.var(counts) / (np.mean(counts) * (1 - 1 / counts.size)))


def _counts(position: np.ndarray, length: float, side: int) -> np.ndarray:
    """Return the number of particles in each of side^3 equal cells of the box."""
    cell = np.floor(position * (side / length)).astype(int) % side
    return np.bincount(np.ravel_multi_index(cell.T, (side,) * 3), minlength=side**3)


def momentum_drift(start: np.ndarray, end: np.ndarray) -> float:
    """Return |<v(end)> - <v(start)>| / u' from the velocities (n, 3) at two times.

    u' is the rms of a velocity component about its mean at the start. Tracers of a flow that keeps its momentum have a
    drift of order n^(-1/2), because they sample the flow at only n points.
    """
    start, end = (velocity.astype(float) for velocity in (start, end))
    return float(np.linalg.norm(end.mean(0) - start.mean(0)) / np.std(start - start.mean(0)))


def mean_drift(start: np.ndarray, end: np.ndarray) -> float:
    """Return <rho(end)> / <rho(start)> - 1 from the densities (n,) at two times."""
    before = np.mean(start, dtype=float)
    return float((np.mean(end, dtype=float) - before) / before)


def drifts(run: Rollout) -> dict[str, dict[str, float]]:
    """Return drifts from the first to the last common time, and the variance of counts at the last common time.

    Each name has the two values "model" and "truth". Names are `momentum_drift`, `count_variance` and, for a model that
    integrates a density, `density_drift`.
    """
    columns = {"momentum_drift": ("velocity", momentum_drift)}
    if run.attributes.get("integrates_density", False):
        columns["density_drift"] = ("density", mean_drift)
    result = {}
    for name, (column, drift) in columns.items():
        start, end = run.pair(0, column), run.pair(-1, column)
        result[name] = {of: drift(getattr(start, of), getattr(end, of)) for of in ("model", "truth")}
    position = run.pair(-1, "position")
    result["count_variance"] = {of: count_variance(getattr(position, of), run.length) for of in ("model", "truth")}
    return result
