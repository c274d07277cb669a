"""Energy spectra of a rollout beside those of the truth."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from eddies.analysis.spectra import band_ratios, spectrum_error

Table = Mapping[str, np.ndarray]  # columns wavenumber (shells,), time (m,), energy or others (m, shells)


@dataclass(frozen=True)
class SpectraAt:
    """Spectra at one time, (shells,) each from k = 0 on: of the model's particles and of the true ones, found alike in
    their velocities; and of the filtered flow itself, None where that is not known."""

    time: float
    wavenumber: np.ndarray
    model: np.ndarray
    truth: np.ndarray
    filtered: np.ndarray | None

    def error(self, of: str, filter_wavenumber: float) -> float:
        """`spectrum_error` of "model" or "truth" against the filtered flow, up to k_d or the last shell there is."""
        return spectrum_error(getattr(self, of), self._known, self._largest(filter_wavenumber))

    def bands(self, of: str, filter_wavenumber: float) -> dict[str, float]:
        """`band_ratios` of "model" or "truth" to the filtered flow, as far."""
        return band_ratios(getattr(self, of), self._known, self._largest(filter_wavenumber))

    @property
    def _known(self) -> np.ndarray:
        assert self.filtered is not None
        return self.filtered

    def _largest(self, filter_wavenumber: float) -> float:
        return min(filter_wavenumber, float(self.wavenumber[-1]))


@dataclass(frozen=True)
class RolloutSpectra:
    """The spectra that a rollout has stored.

    Parameters
    ----------
    model, truth : tables with `energy`, from the start on; the model's times are those of the truth and perhaps more.
    flow : the table of the ground truth, with `filtered`, or None; its times count from the release of the tracers.
    start_time : of the rollout, in that time.
    """

    model: Table
    truth: Table
    flow: Table | None
    start_time: float

    def times(self, until: float = np.inf) -> np.ndarray:
        """Times before `until` at which there is a truth."""
        return self.truth["time"][self.truth["time"] < until]

    def at(self, time: float) -> SpectraAt:
        """Those at the moment nearest to a time at which there is a truth."""
        truth = int(np.argmin(np.abs(self.truth["time"] - time)))
        found = float(self.truth["time"][truth])
        model = int(np.argmin(np.abs(self.model["time"] - found)))
        shells, filtered = self.model["wavenumber"].size, None
        if self.flow is not None:
            shells = min(shells, self.flow["wavenumber"].size)
            nearest = int(np.argmin(np.abs(self.flow["time"] - (self.start_time + found))))
            filtered = self.flow["filtered"][nearest][:shells]
        return SpectraAt(found, self.model["wavenumber"][:shells], self.model["energy"][model][:shells],
                         self.truth["energy"][truth][:shells], filtered)
