"""How evenly particles lie, and what moves below the filter: signs of disorder that a particle model may gather.

Particles put at random that follow a solenoidal flow stay random. Those of a model may cluster, line up or shake.
"""

import itertools
from collections.abc import Sequence

import numpy as np

from eddies.analysis.lagrangian import minimum_image
from eddies.analysis.pdfs import bin_probabilities
from eddies.analysis.rollout import Frames

# Bins of the PDF of nearest-neighbour distances, in mean spacings; of random points exp(-14) lie beyond.
DISTANCE_EDGES = np.linspace(0, 1.5, 31)
SAMPLED = 2**15  # particles whose nearest neighbour is searched, at most
PAIRS_TOGETHER = 2**20  # pairs whose distances are held at once
CELL = 2.0  # side of the cells in which particles are counted, in mean spacings: about a filter width


def mean_spacing(total: int, length: float) -> float:
    """Side of the cube that each of `total` particles has to itself, length / total^(1/3)."""
    return length / total ** (1 / 3)


def nearest_distances(position: np.ndarray, length: float) -> np.ndarray:
    """Distance to the nearest other particle of at most `SAMPLED` particles, evenly chosen by row: (n, 3) -> (m,).

    Positions lie in the periodic cube of side `length`, in any arrangement. Infinite for a particle that is alone.
    """
    chosen = np.unique(np.linspace(0, len(position) - 1, min(len(position), SAMPLED)).astype(int))
    cells = max(int(len(position) ** (1 / 3) / 1.5), 3)
    scaled = position * (cells / length)
    cell = np.floor(scaled).astype(int)
    below, cell = scaled[chosen] - cell[chosen], cell % cells
    index = np.ravel_multi_index(cell.T, (cells,) * 3)
    order = np.argsort(index, kind="stable")
    counts = np.bincount(index, minlength=cells**3)
    starts = np.cumsum(counts) - counts
    nearest = np.full(chosen.size, np.inf)
    # The own cell comes first: once a neighbour is known, most of those beside are farther. Their gaps are rounded.
    for offset in sorted(itertools.product((-1, 0, 1), repeat=3), key=np.linalg.norm):
        gaps = np.where(np.equal(offset, 0), 0, np.where(np.less(offset, 0), below, 1 - below))
        some = np.flatnonzero(nearest > length / cells * (np.linalg.norm(gaps, axis=1) - 1e-3))
        beside = np.ravel_multi_index(((cell[chosen[some]] + offset) % cells).T, (cells,) * 3)
        nearest[some] = _keep_smaller(nearest[some], position, chosen[some], order, starts[beside], counts[beside],
                                      length)
    # The cells around hold all within a cell's side, and the whole box where there are three of them.
    far = np.flatnonzero(nearest > length / cells) if cells > 3 else np.empty(0, int)
    everyone = np.full(far.size, len(position))
    nearest[far] = _keep_smaller(nearest[far], position, chosen[far], order, 0 * everyone, everyone, length)
    return nearest


def _keep_smaller(nearest: np.ndarray, position: np.ndarray, chosen: np.ndarray, order: np.ndarray,
                  starts: np.ndarray, counts: np.ndarray, length: float) -> np.ndarray:
    """Lower `nearest` (m,) to the distance from each chosen row to the rows order[start:start + count]; returns it."""
    rows = np.flatnonzero(counts)
    block = np.cumsum(counts[rows]) // PAIRS_TOGETHER
    for rows in np.split(rows, np.flatnonzero(np.diff(block)) + 1):
        if rows.size == 0:
            continue
        count = counts[rows]
        begin = np.cumsum(count) - count
        first = np.repeat(chosen[rows], count)
        second = order[np.arange(count.sum()) + np.repeat(starts[rows] - begin, count)]
        apart = minimum_image(position[second] - position[first], length)
        distance = np.sqrt(np.sum(apart**2, axis=1))
        distance[first == second] = np.inf
        nearest[rows] = np.minimum(nearest[rows], np.minimum.reduceat(distance, begin))
    return nearest


def distance_probabilities(position: np.ndarray, length: float) -> np.ndarray:
    """Share of nearest-neighbour distances in the bins DISTANCE_EDGES, in mean spacings: (n, 3) -> (bins,).

    Raises ValueError for fewer than two particles.
    """
    return bin_probabilities(nearest_distances(position, length) / mean_spacing(len(position), length),
                             DISTANCE_EDGES)


def random_distance_density(distance: np.ndarray) -> np.ndarray:
    """PDF of the nearest-neighbour distance of random points, 4 pi n r^2 exp(-4/3 pi n r^3) with n = 1 (Hertz 1909).

    The distance is in mean spacings.
    """
    return 4 * np.pi * distance**2 * np.exp(-4 / 3 * np.pi * distance**3)


def count_variance(position: np.ndarray, length: float) -> float:
    """Variance of the counts in cells of side `CELL` mean spacings over that of random points: (n, 3) -> scalar.

    Random points share out as a multinomial, whose variance is the mean times 1 - 1/cells. So 1: random, 0: as even
    as can be, above 1: clustered; of random points it is 1 within sqrt(2 / cells). Not a number for so few particles
    that there are not two cells a side.
    """
    side = round(len(position) ** (1 / 3) / CELL)
    if side < 2:
        return np.nan
    cell = np.floor(position * (side / length)).astype(int) % side
    counts = np.bincount(np.ravel_multi_index(cell.T, (side,) * 3), minlength=side**3)
    return float(np.var(counts) / (np.mean(counts) * (1 - 1 / counts.size)))


def count_variance_series(frames: Frames, chosen: Sequence[int], length: float) -> dict[str, np.ndarray]:
    """Columns time and count_variance over the chosen frames of a trajectory."""
    return {"time": frames.times[np.asarray(chosen)],
            "count_variance": np.array([count_variance(frames.read(int(frame), "position"), length)
                                        for frame in chosen])}
