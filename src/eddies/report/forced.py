"""The report's part on a forced rollout: its statistics beside those of the stationary state of the ground truth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eddies.analysis.against_truth import EDGES, Frames, first_broken_time, normalized_invariants
from eddies.analysis.isotropic_turbulence import StationarySpan
from eddies.analysis.pdfs import bin_probabilities, gaussian, kl_divergence, pdf, standardized
from eddies.analysis.spectra import energy_spectrum, spectrum_error
from eddies.analysis.velocity_gradients import InvariantBins, enstrophy_scale
from eddies.report.figures import GUIDE, MODEL, TRUTH, letter, number_wavenumbers, panels, styled
from eddies.report.page import Metric, Section
from eddies.report.rollout import Rollout


@dataclass(frozen=True)
class ForcedStatistics:
    """A forced rollout and the stationary flow that it should be like.

    Parameters
    ----------
    times, energy : of the model, (frames,), <v.v>/2.
    late : its frames in the second half, over which it is averaged.
    flow_energy : mean and standard deviation of the filtered flow's energy over its stationary span.
    wavenumber, spectrum, flow_spectrum : mean spectra (shells,) through the kernel.
    velocity, acceleration : of the model's late frames, divided by the standard deviation of their frame.
    flow_velocity, flow_acceleration : the same of the true tracers at the start, when they had just been forced.
    acceleration_rms, flow_acceleration_rms : of one component, (late frames,) and at the start.
    qr_kl : divergence of the Q-R joint PDFs, each in units of its own enstrophy.
    """

    times: np.ndarray
    energy: np.ndarray
    late: np.ndarray
    flow_energy: tuple[float, float]
    wavenumber: np.ndarray
    spectrum: np.ndarray
    flow_spectrum: np.ndarray
    velocity: np.ndarray
    flow_velocity: np.ndarray
    acceleration: np.ndarray
    flow_acceleration: np.ndarray
    acceleration_rms: np.ndarray
    flow_acceleration_rms: float
    qr_kl: float

    @classmethod
    def of(cls, run: Rollout, span: StationarySpan) -> "ForcedStatistics":
        """The statistics of a rollout whose filter width is known; the frames before it broke, if it did.

        Raises ValueError if there is no such frame.
        """
        frames = np.flatnonzero(run.model.times < first_broken_time(run.model))
        if not len(frames):
            raise ValueError("the model has no finite frame")
        times = run.model.times[frames]
        late = frames[times >= times[-1] / 2]
        energy = np.array([0.5 * np.mean(np.sum(run.model.read(frame, "velocity") ** 2, axis=1)) for frame in frames])
        shells = np.arange(span.spectra.shape[1])
        transfer = np.exp(-((shells * run.filter_width) ** 2) / 12)
        wavenumber, spectrum = mean_spectrum(run.fields["model"], times[len(times) - len(late):])
        start = run.model.times[:1]
        # What the kernel makes of a filtered field, shell by shell: both reconstructions are attenuated alike.
        _, through_kernel = mean_spectrum(run.fields["truth"], start)
        _, unsmoothed = mean_spectrum(run.fields["filtered"], start)
        resolved = slice(0, min(len(wavenumber), len(shells)))
        attenuation = np.divide(through_kernel, unsmoothed, out=np.zeros_like(unsmoothed), where=unsmoothed > 0)
        accelerations = [run.model.read(frame, "acceleration") for frame in late]
        flow = {name: run.truth.read(0, name) for name in ("velocity", "acceleration", "velocity_gradient")}
        return cls(
            times, energy, late, span.average(span.spectra @ transfer), wavenumber[resolved], spectrum[resolved],
            attenuation[resolved] * (transfer * span.spectrum)[resolved],
            np.concatenate([standardized(run.model.read(frame, "velocity")) for frame in late]),
            standardized(flow["velocity"]),
            np.concatenate([standardized(acceleration) for acceleration in accelerations]),
            standardized(flow["acceleration"]),
            np.array([np.std(acceleration) for acceleration in accelerations]), float(np.std(flow["acceleration"])),
            invariant_divergence([run.model.read(frame, "velocity_gradient") for frame in late],
                                 flow["velocity_gradient"]))

    @property
    def late_energy(self) -> tuple[float, float]:
        """Mean and standard deviation of the model's energy over its second half."""
        chosen = self.energy[len(self.energy) - len(self.late):]
        return float(chosen.mean()), float(chosen.std())

    def divergence(self, column: str) -> float:
        """Forward KL divergence of the standardised PDFs of "velocity" or "acceleration", flow to model."""
        flow, model = (bin_probabilities(values, EDGES[column])
                       for values in (getattr(self, f"flow_{column}"), getattr(self, column)))
        return kl_divergence(flow, model)


def mean_spectrum(fields: Frames, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Wavenumbers and mean energy spectrum (shells,) of a field series at the stored times nearest to `times`."""
    frames = {int(np.argmin(np.abs(fields.times - time))) for time in times}
    spectra = [energy_spectrum(np.asarray(fields.read(frame, "velocity"), dtype=float)) for frame in sorted(frames)]
    return spectra[0][0], np.mean([energy for _, energy in spectra], axis=0)


def invariant_divergence(model: Sequence[np.ndarray], flow: np.ndarray) -> float:
    """Forward KL divergence of the joint PDFs of Q and R, of all frames of the model together."""
    true_plane, *planes = (normalized_invariants(gradient, enstrophy_scale(gradient)) for gradient in (flow, *model))
    bins = InvariantBins.covering(*true_plane)
    return kl_divergence(bins.probabilities(*true_plane), bins.probabilities(*np.concatenate(planes, axis=1)))


def section(run: Rollout, span: StationarySpan) -> Section:
    """A forced rollout beside the stationary state of a ground truth whose filter width is known."""
    title = "Forced rollout beside the stationary state"
    try:
        found, turnover = ForcedStatistics.of(run, span), run.turnover
    except ValueError as error:
        return Section("forced", title, notices=[f"It is not compared: {error}."])
    half = run.filter_wavenumber / 2
    (energy, deviation), (flow_energy, flow_deviation) = found.late_energy, found.flow_energy
    error = spectrum_error(found.wavenumber, found.spectrum, found.flow_spectrum, max(1.0, half))
    begin = run.model.times[found.late[0]]
    shown = Section(
        "forced", title,
        f"The model is forced with a power of {float(run.attributes['injection_rate']):.3g} a mass. Its averages, from "
        f"{begin / turnover:.3g} to {found.times[-1] / turnover:.3g} T, beside those of the filtered flow over the "
        f"{span.turnovers:.3g} turnovers in which it was stationary. PDFs are compared with those of the true tracers "
        "at the start, each in units of its own standard deviation.",
        metrics=[
            Metric("energy", "kinetic energy", {"model": energy, "deviation": deviation, "stationary flow": flow_energy,
                                                "its deviation": flow_deviation}),
            Metric("acceleration_rms", "rms of an acceleration component",
                   {"model": float(found.acceleration_rms.mean()), "deviation": float(found.acceleration_rms.std()),
                    "flow at the start": found.flow_acceleration_rms}),
            Metric("spectrum_error", "error of the mean spectrum, 1 ≤ k ≤ k_d/2 (relative L2)", error),
            Metric("velocity_kl", "KL divergence of the velocity PDF, standardised", found.divergence("velocity")),
            Metric("acceleration_kl", "KL divergence of the acceleration PDF, standardised",
                   found.divergence("acceleration")),
            Metric("qr_kl", "KL divergence of the Q–R joint PDF, standardised", found.qr_kl),
        ])
    shown.add_figure(
        "forced", "Forced rollout", forced_rollout(found, turnover, run.filter_wavenumber),
        f"Energy of the model {energy:.3g} ± {deviation:.2g}, of the stationary flow {flow_energy:.3g} ± "
        f"{flow_deviation:.2g} (band; ± is the standard deviation in time). Mean spectra through the kernel differ by "
        f"{error:.3f} up to k_d/2 (dotted: k_d). KL of the acceleration PDF {found.divergence('acceleration'):.2g}.")
    return shown


@styled
def forced_rollout(found: ForcedStatistics, turnover: float, cutoff: float) -> Figure:
    """Energy over time, mean spectra and acceleration PDFs of the model and of the stationary flow."""
    figure, axes = panels(1, 3, (3.7, 3.2))
    energy, spectra, accelerations = axes.flat
    mean, deviation = found.flow_energy
    energy.axhspan(mean - deviation, mean + deviation, color=TRUTH, alpha=0.2, linewidth=0)
    energy.axhline(mean, color=TRUTH, label="stationary flow")
    energy.plot(found.times / turnover, found.energy, color=MODEL, label="forced model")
    energy.set(title="Kinetic energy", xlabel="$t/T$", ylabel=r"$\langle v\cdot v\rangle/2$",
               ylim=(0, 1.15 * max(found.energy.max(), mean + deviation)))
    energy.legend(loc="lower left")
    _draw_spectra(spectra, found, cutoff)
    edges = EDGES["acceleration"]
    middle = (edges[1:] + edges[:-1]) / 2
    for values, colour, label in ((found.flow_acceleration, TRUTH, "true tracers at the start"),
                                  (found.acceleration, MODEL, "forced model")):
        density = pdf(values, edges)
        accelerations.semilogy(middle[density > 0], density[density > 0], color=colour, label=label)
    accelerations.plot(middle, gaussian(middle), color=GUIDE, linestyle="--", linewidth=1.1, label="Gaussian")
    accelerations.set(title="Acceleration PDF", xlabel="$a$ / its standard deviation", ylim=(1e-6, 1))
    accelerations.legend(loc="lower center")
    letter(axes.flat)
    return figure


def _draw_spectra(axis: Axes, found: ForcedStatistics, cutoff: float) -> None:
    shown = (found.wavenumber >= 1) & (found.wavenumber <= 2 * cutoff)
    for energy, colour in ((found.flow_spectrum, TRUTH), (found.spectrum, MODEL)):
        axis.loglog(found.wavenumber[shown], energy[shown], color=colour, marker="o", markersize=3)
    axis.axvline(cutoff, color=GUIDE, linestyle=":")
    axis.set(title="Mean spectrum", xlabel="$k$", ylabel="$E(k)$")
    number_wavenumbers(axis)
