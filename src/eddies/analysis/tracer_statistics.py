"""Statistics of the tracers of a ground truth: energy, acceleration, Lagrangian structure function, pair dispersion.

Tracers usually follow the filtered flow. Then only the eddies that pass the filter determine the accelerations of the
tracers and the changes of their small separations.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from eddies.analysis.errors import fluctuations
from eddies.analysis.lagrangian import lags_of, pair_dispersion, pairs_at, structure_function
from eddies.analysis.pdfs import bin_edges, pdf
from eddies.analysis.rollout import Frames

FOLLOWED = 2**14  # largest number of tracers whose velocities at all times are in memory at once
CENTRES = 1000  # number of tracers around which pairs are searched
PAIRS, FEWEST = 10_000, 30  # largest and smallest number of pairs at a distance; with fewer, the distance is left out
SEPARATIONS, TOLERANCE = (0.5, 1.0, 2.0, 4.0), 0.1  # initial distances of pairs in mean spacings; relative tolerance
EDGES = bin_edges(12, 120)  # bins of the PDF of accelerations, in standard deviations


@dataclass(frozen=True)
class Dispersion:
    """Means over the pairs of tracers that start at the distance `distance` from each other.

    `spread` is <|r(t) - r(0)|^2> of the separation r of a pair, (frames,). `structure` is <|v_1 - v_2|^2> at the start,
    with the velocities v_1 and v_2 of a pair.
    """

    distance: float
    spread: np.ndarray
    structure: float


@dataclass(frozen=True)
class TracerStatistics:
    """Statistics of the tracers of a run.

    Parameters
    ----------
    times, field_times : times of the frames since the first, (frames,), and of the stored fields, (fields,).
    energy_ratio : <v.v> of the tracers divided by <v.v> of the filtered field, at `field_times`, (fields,). v is the
        velocity minus its mean.
    energy_error : standard deviation of this ratio for the same number of random points, (fields,).
    probability : PDF of an acceleration component divided by its rms at the same time, in the bins EDGES, (bins,).
        Accelerations are velocity differences of successive frames.
    kurtosis : kurtosis of this PDF; 3 if it is Gaussian.
    acceleration_rms : rms of an acceleration component over the first interval.
    structure : Lagrangian structure function of a velocity component at the time lags `lags`.
    dispersion : pair dispersion for each initial distance.
    """

    times: np.ndarray
    field_times: np.ndarray
    energy_ratio: np.ndarray
    energy_error: np.ndarray
    probability: np.ndarray
    kurtosis: float
    acceleration_rms: float
    lags: np.ndarray
    structure: np.ndarray
    dispersion: list[Dispersion]

    @property
    def structure_exponent(self) -> float:
        """Exponent of the structure function between the first two lags. It is 2 if the accelerations are resolved."""
        return first_exponent(self.lags, self.structure)

    @property
    def ballistic_exponent(self) -> float:
        """Exponent of the pair dispersion between the first two times after the start, averaged over distances.

        It is 2 if each pair keeps its initial velocities (ballistic motion).
        """
        exponents = [first_exponent(self.times[1:], pairs.spread[1:]) for pairs in self.dispersion]
        return float(np.mean(exponents)) if exponents else np.nan

    @property
    def ballistic_prefactor(self) -> float:
        """<|r - r0|^2> / (<|v_1 - v_2|^2> t^2) at the first time t after the start, averaged over distances.

        It is 1 for ballistic motion.
        """
        ratios = [pairs.spread[1] / (pairs.structure * self.times[1] ** 2) for pairs in self.dispersion]
        return float(np.mean(ratios)) if ratios else np.nan


def first_exponent(x: np.ndarray, y: np.ndarray) -> float:
    """Return the slope of log y over log x between the first two points.

    It is NaN if there are fewer points, or if y[0] is not positive.
    """
    return float(np.log(y[1] / y[0]) / np.log(x[1] / x[0])) if len(x) > 1 and y[0] > 0 else np.nan


def tracer_statistics(tracers: Frames, spectra: Mapping[str, np.ndarray], spacing: float) -> TracerStatistics:
    """Return the statistics of tracers, measured in frames at equal intervals.

    `spectra` holds `time` (m,) and `filtered` (m, shells), the energy spectra of the filtered flow. `spacing` is the
    mean spacing of the tracers.
    """
    times, every = tracers.times, -(-tracers.total // FOLLOWED)
    velocity = np.stack([tracers.read(frame, "velocity")[::every] for frame in range(times.size)])
    interval = (times[-1] - times[0]) / (times.size - 1)
    lags = lags_of(max(times.size // 2, 1))
    probability, kurtosis = _accelerations(velocity)
    return TracerStatistics(
        times - times[0], spectra["time"], *_energy_ratio(tracers, spectra), probability, kurtosis,
        float(np.sqrt(np.mean((velocity[1] - velocity[0]) ** 2)) / interval),
        lags * interval, structure_function(velocity, lags), _dispersion(tracers, spacing))


def _energy_ratio(tracers: Frames, spectra: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    ratios, errors = [], []
    for time, filtered in zip(spectra["time"], spectra["filtered"]):
        frame = int(np.argmin(np.abs(tracers.times - time)))
        squared = np.sum(fluctuations(tracers.read(frame, "velocity")) ** 2, axis=1)
        ratios.append(squared.mean() / (2 * filtered.sum()))
        errors.append(squared.std() / squared.mean() / np.sqrt(squared.size))
    return np.array(ratios), np.array(errors)


def _accelerations(velocity: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the PDF and the kurtosis of accelerations, both averaged over the intervals between frames.

    `velocity` is (frames, n, 3). The accelerations of each interval are divided by their own rms, so that the decay of
    the flow does not widen the tails.
    """
    probability, kurtosis = [], []
    for earlier, later in zip(velocity, velocity[1:]):
        rms = np.sqrt(np.mean((later - earlier) ** 2))
        if rms == 0:
            return np.zeros(EDGES.size - 1), np.nan
        scaled = (later - earlier) / rms
        probability.append(pdf(scaled, EDGES))
        kurtosis.append(np.mean(scaled**4))
    return np.mean(probability, axis=0), float(np.mean(kurtosis))


def _dispersion(tracers: Frames, spacing: float) -> list[Dispersion]:
    start, velocity = (tracers.read(0, column) for column in ("position", "velocity"))
    distances = [spacing * factor for factor in SEPARATIONS if spacing * factor < tracers.length / 2]
    groups = {distance: pairs[:, ::-(-pairs.shape[1] // PAIRS)] for distance, pairs
              in zip(distances, pairs_at(start, tracers.length, distances, TOLERANCE, CENTRES))
              if pairs.shape[1] >= FEWEST}
    if not groups:
        return []
    frames = (tracers.read(frame, "position") for frame in range(tracers.times.size))
    spreads = pair_dispersion(frames, list(groups.values()), tracers.length)
    return [Dispersion(distance, spread,
                       float(np.mean(np.sum((velocity[pairs[0]] - velocity[pairs[1]]) ** 2, axis=1))))
            for (distance, pairs), spread in zip(groups.items(), spreads)]
