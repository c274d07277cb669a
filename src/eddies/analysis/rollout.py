"""A rollout and the true particles: frames of both, and quantities that are measured in the same way in both."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np

from eddies.analysis.velocity_gradients import Invariants
from eddies.clock import ROUND_OFF, SAME

# Columns by name. A table of spectra has wavenumber (shells,), time (m,), energy (m, shells).
Table = Mapping[str, np.ndarray]


def same_times(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of `first` (m,) and of `second` (n,) that are at the same times, as two arrays of equal length.

    Both are times in ascending order. Two times are the same if they differ by at most SAME times the shortest interval
    in both, or, without an interval, SAME times the larger time.
    """
    intervals = [np.diff(times).min() for times in (first, second) if len(times) > 1]
    gap = np.abs(np.subtract.outer(first, second))
    return np.nonzero(gap <= SAME * min(intervals, default=np.abs([*first, *second]).max(initial=0.0)))


class Frames(Protocol):
    """`total` particles at several times, in a periodic box of edge `length`."""

    times: np.ndarray
    columns: Collection[str]
    total: int
    length: float

    def read(self, frame: int, column: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Return the rows start, ..., stop - 1 of a column in a frame. Rows are particles in order of id."""


class CommonFrames(NamedTuple):
    """Frames of model and truth at the same times: the frame numbers of both, and these times, each (m,)."""

    model: np.ndarray
    truth: np.ndarray
    times: np.ndarray


class Pair(NamedTuple):
    """One quantity of model and truth at one time."""

    model: np.ndarray
    truth: np.ndarray


@dataclass(frozen=True)
class Rollout:
    """A rollout and the true particles, with measures of both in single frames.

    Parameters
    ----------
    attributes : attributes of the group `rollout` in rollout.h5.
    model, truth : particles, at times since the start of the rollout. The truth may end before the model. Without a
        ground truth, `truth` has no frames, and `without_truth` gives the reason.
    flow : table `spectra` of the ground truth, with the columns `energy` of the flow and `filtered` of the filtered
        flow. Its times count from the release of the tracers.
    reference : scales of the ground truth, by name.
    spectra : for "model" and "truth", the energy spectrum (shells,) by frame number. It comes from a least-squares fit
        of modes to the velocities of the particles.
    invariants : for "model" and "truth", the invariants of the velocity gradients at the particles, by frame number.
        None without a kernel, because the kernel reconstructs the gradients.
    planes : for "model" and "truth", velocity (3, n, n) and vorticity magnitude (n, n) of the reconstructed field in
        the plane z = pi, by frame number. The velocity is relative to the mean over the particles. The last two axes
        are y, x. None without a kernel.
    outside_training : share of the particle pairs for which an input of a network is outside its range in training,
        (frames,); None if it was not counted.
    closure : columns (frames,) `solves`, `iterations`, `most_iterations`, `residual` and `not_converged` of the
        iterative solves for the resolved velocity since the previous frame; None if there were no solves.
    reconstructed_by : name of the reconstruction method, for captions.
    """

    attributes: Mapping[str, float | str]
    model: Frames
    truth: Frames
    flow: Table
    reference: Mapping[str, float]
    spectra: Mapping[str, Mapping[int, np.ndarray]]
    invariants: Mapping[str, Mapping[int, Invariants]] | None
    planes: Mapping[str, Mapping[int, tuple[np.ndarray, np.ndarray]]] | None = None
    outside_training: np.ndarray | None = None
    closure: Table | None = None
    without_truth: str = ""
    reconstructed_by: str = ""

    @property
    def length(self) -> float:
        """Edge of the box."""
        return self.model.length

    @property
    def turnover(self) -> float:
        """Eddy turnover time T, the unit of time in the figures."""
        return float(self.attributes["eddy_turnover_time"])

    @property
    def start_time(self) -> float:
        """Time from the release of the tracers to the start of the rollout."""
        return float(self.attributes["start_time"])

    @property
    def filter_width(self) -> float:
        return float(self.reference["filter_width"])

    @property
    def filter_wavenumber(self) -> float:
        """Wavenumber k_d = pi / d of the filter of width d."""
        return np.pi / self.filter_width

    @property
    def forced(self) -> bool:
        """Whether the large scales of the model are forced."""
        return self.powers[0] > 0

    @property
    def powers(self) -> tuple[float, float]:
        """Power per mass of the forcing in the model, and that in the true flow."""
        model, truth = (float(self.attributes.get(name, 0.0)) for name in ("injection_rate", "truth_injection_rate"))
        return model, truth

    @property
    def status(self) -> str:
        """How the rollout ended: "complete", or "stopped: reason"."""
        return str(self.attributes["status"])

    @cached_property
    def broken(self) -> float:
        """Time of the first frame with a position, velocity or acceleration that is not finite; infinity if there is
        none."""
        columns = "position", "velocity", "acceleration"
        for frame, time in enumerate(self.model.times):
            if not all(np.isfinite(self.model.read(frame, column)).all() for column in columns):
                return float(time)
        return np.inf

    @cached_property
    def common(self) -> CommonFrames:
        """The frames of both before the time `broken` that have the `same_times`. Raises ValueError, with the reason,
        if there are none."""
        if not len(self.truth.times) and self.without_truth:
            raise ValueError(self.without_truth)
        model, truth = same_times(self.model.times, self.truth.times)
        early = self.model.times[model] < self.broken
        if not early.any():
            raise ValueError("there is no time at which model and truth both have finite values")
        return CommonFrames(model[early], truth[early], self.model.times[model[early]])

    def before_broken(self, of: str) -> np.ndarray:
        """Return the frame numbers before the time `broken`. `of` is "model" or "truth"."""
        return np.flatnonzero(getattr(self, of).times < self.broken)

    def pair(self, index: int, column: str) -> Pair:
        """Return a column of model and truth at the common frame `index`. Rows are particles in order of id."""
        return Pair(self.model.read(int(self.common.model[index]), column),
                    self.truth.read(int(self.common.truth[index]), column))

    def both(self, measures: Mapping[str, Mapping[int, Any]], index: int) -> tuple[Any, Any]:
        """Return the values of model and truth at the common frame `index`; `measures` is, for example, `spectra`."""
        return measures["model"][int(self.common.model[index])], measures["truth"][int(self.common.truth[index])]

    @property
    def late(self) -> np.ndarray:
        """Frame numbers of the model in the second half of the time before `broken`."""
        frames = self.before_broken("model")
        return frames[second_half(self.model.times[frames], float(self.model.times[frames[-1]]))]

    def spectral(self) -> np.ndarray:
        """Return the indices of the common frames at whose times the spectrum of the flow is stored."""
        return np.flatnonzero(self._has_flow(self.common.times))

    def shown(self, rows: np.ndarray) -> np.ndarray:
        """Return those of the common frames `rows` that are nearest to the times of the figures.

        These are the start, the Kolmogorov time, T/2 and T, as far as they are clearly before the end, and the end.
        """
        times = self.common.times[rows]
        early = [time for time in (0.0, self.reference["kolmogorov_time"], self.turnover / 2, self.turnover)
                 if time < 0.9 * times[-1]]
        return rows[np.unique(np.abs(times - np.array([*early, times[-1]])[:, None]).argmin(1))]

    def shown_spectra(self) -> np.ndarray:
        """Return those of the indices that `spectral` returns which the figures show."""
        return self.shown(self.spectral())

    def late_spectra(self) -> np.ndarray:
        """Return the frame numbers over which the spectrum of the model is averaged.

        They are in the second half of the time before `broken`. A frame is used if the spectrum of the flow is stored
        at its time, or if the truth has no frame at this time. If the second half has no such frame, the last such
        frame of the first half is used.
        """
        times = self.model.times
        chosen = self._has_flow(times) | ~_contained(times, self.truth.times)
        frames = np.flatnonzero(chosen & (times < self.broken))
        return frames[second_half(times[frames], float(times[self.before_broken("model")[-1]]))]

    def spectra_at(self, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the energy spectra (shells,) of model, truth and filtered flow at the common frame `index`, in the
        shells that all three have.

        The spectrum of the filtered flow is the one at the nearest stored time.
        """
        model, truth = self.both(self.spectra, index)
        shells = min(len(model), self.flow["wavenumber"].size)
        return model[:shells], truth[:shells], self.flow["filtered"][self.flow_row(index)][:shells]

    def flow_row(self, index: int) -> int:
        """Return the row of the table `flow` whose time is the nearest to that of the common frame `index`."""
        return int(np.argmin(np.abs(self.flow["time"] - (self.start_time + self.common.times[index]))))

    def _has_flow(self, times: np.ndarray) -> np.ndarray:
        return _contained(self.start_time + times, self.flow["time"])


def second_half(times: np.ndarray, end: float) -> np.ndarray:
    """Return the rows of the increasing `times` that are within [end / 2, end].

    If there are none, return the last row before `end`, or row 0.
    """
    rows = np.flatnonzero((times >= end / 2) & (times <= end * (1 + ROUND_OFF)))
    return rows if rows.size else np.array([max(int(np.searchsorted(times, end, "right")) - 1, 0)])


def _contained(times: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Return, for each of `times` (m,), whether it is the same as one of the times `among` (l,)."""
    return np.isin(np.arange(len(times)), same_times(times, among)[0])
