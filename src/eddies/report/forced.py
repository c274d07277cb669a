"""The report's part on a forced rollout: its statistics beside those of the stationary state of the ground truth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eddies.analysis.against_truth import EDGES, mean_energy
from eddies.analysis.block_averages import Blocks, Estimate
from eddies.analysis.isotropic_turbulence import StationarySpan
from eddies.analysis.pdfs import bin_probabilities, gaussian, kl_divergence, pdf, standardized
from eddies.analysis.rollout import Frames, Rollout, second_half
from eddies.analysis.spectra import spectrum_error
from eddies.analysis.velocity_gradients import InvariantBins, Invariants
from eddies.report.figures import GUIDE, MODEL, TRUTH, letter, number_wavenumbers, panels, styled
from eddies.report.page import Metric, Section
from eddies.report.rollout import WITHOUT_KERNEL
from eddies.spectral.mode_operators import gaussian_transfer


@dataclass(frozen=True)
class LateFrames:
    """Energy <v.v>/2 and rms of a component of the acceleration of particles at frames over which they are averaged,
    (m,) each, with the blocks of these frames, a turnover or more each."""

    blocks: Blocks
    energy: np.ndarray
    acceleration_rms: np.ndarray

    @classmethod
    def of(cls, run: Frames, frames: np.ndarray, turnover: float) -> "LateFrames":
        """Of frames of a trajectory."""
        return cls(Blocks.of(run.times[frames] / turnover, 1.0),
                   np.array([mean_energy(run, frame) for frame in frames]),
                   np.array([np.std(run.read(frame, "acceleration")) for frame in frames]))

    def averages(self, name: str, whose: str) -> dict[str, float]:
        """Mean, named `whose`, and slope per turnover of "energy" or "acceleration_rms", each with its standard error,
        and the standard deviation in time."""
        samples = getattr(self, name)
        mean, slope = self.blocks.mean(samples), self.blocks.trend(samples)
        return {whose: mean.value, "standard error": mean.error, "trend per turnover": slope.value,
                "error of the trend": slope.error, "deviation": float(samples.std())}


@dataclass(frozen=True)
class ForcedStatistics:
    """A forced rollout and the stationary flow that it should be like.

    Parameters
    ----------
    times, energy : of the model, (frames,), <v.v>/2.
    late : its frames in the second half, over which it is averaged; model : of these.
    truth : of the true tracers at the same times, where they are forced too and last as long.
    flow_energy : mean of the filtered flow's energy over its stationary span, by blocks too; flow_deviation : its
        standard deviation in time.
    wavenumber, flow_spectrum : the flow's mean filtered spectrum, (shells,). spectra : of the model, (m, shells), at
        the times of `spectra_blocks`. cutoff : k_d, or the last of these shells.
    velocity, acceleration : of the model's late frames, divided by the standard deviation of their frame.
    flow_velocity, flow_acceleration : the same of the true tracers at the start, when they had just been forced.
    flow_acceleration_rms : of one component, at the start.
    qr_kl : divergence of the Q-R joint PDFs, each in units of its own enstrophy; None without a kernel.
    """

    times: np.ndarray
    energy: np.ndarray
    late: np.ndarray
    model: LateFrames
    truth: LateFrames | None
    flow_energy: Estimate
    flow_deviation: float
    wavenumber: np.ndarray
    flow_spectrum: np.ndarray
    spectra_blocks: Blocks
    spectra: np.ndarray
    cutoff: float
    velocity: np.ndarray
    flow_velocity: np.ndarray
    acceleration: np.ndarray
    flow_acceleration: np.ndarray
    flow_acceleration_rms: float
    qr_kl: float | None

    @classmethod
    def of(cls, run: Rollout, span: StationarySpan) -> "ForcedStatistics":
        """The statistics of a rollout with its truth; the frames before it broke, if it did.

        Raises ValueError if there is no such frame.
        """
        frames = run.before_broken("model")
        if not len(frames):
            raise ValueError("the model has no finite frame")
        times = run.model.times[frames]
        late = frames[times >= times[-1] / 2]
        shells = np.arange(span.spectra.shape[1])
        transfer = gaussian_transfer(shells**2, run.filter_width) ** 2
        flow_energy = span.spectra @ transfer
        chosen = run.late_spectra()
        spectra = np.array([run.spectra["model"][int(frame)] for frame in chosen])
        known = min(spectra.shape[1], len(shells))
        flow = {name: run.truth.read(0, name) for name in ("velocity", "acceleration")}
        return cls(
            times, np.array([mean_energy(run.model, frame) for frame in frames]), late,
            LateFrames.of(run.model, late, run.turnover), _late_truth(run, times[-1]),
            span.block_mean(flow_energy), span.average(flow_energy)[1],
            shells[:known], (transfer * span.spectrum)[:known],
            Blocks.of(run.model.times[chosen] / run.turnover, 1.0), spectra[:, :known],
            min(np.pi / run.filter_width, known - 1.0),
            np.concatenate([standardized(run.model.read(frame, "velocity")) for frame in late]),
            standardized(flow["velocity"]),
            np.concatenate([standardized(run.model.read(frame, "acceleration")) for frame in late]),
            standardized(flow["acceleration"]), float(np.std(flow["acceleration"])),
            None if run.reconstructions is None else invariant_divergence(
                [run.reconstructions["model"][int(frame)].invariants for frame in late],
                run.reconstructions["truth"][0].invariants))

    @property
    def spectrum(self) -> np.ndarray:
        """The model's mean spectrum."""
        return self.spectra_blocks.means(self.spectra).mean(axis=0)

    @property
    def spectrum_error(self) -> Estimate:
        """Of the mean spectrum, not the mean of errors."""
        return self.spectra_blocks.of_mean(
            self.spectra, lambda mean: spectrum_error(mean, self.flow_spectrum, self.cutoff))

    def divergence(self, column: str) -> float:
        """Forward KL divergence of the standardised PDFs of "velocity" or "acceleration", flow to model."""
        flow, model = (bin_probabilities(values, EDGES[column])
                       for values in (getattr(self, f"flow_{column}"), getattr(self, column)))
        return kl_divergence(flow, model)


def _late_truth(run: Rollout, end: float) -> LateFrames | None:
    """The true tracers in the second half of what ends at a time, if they are forced and last until then."""
    reached = run.powers[1] > 0 and run.truth.times[-1] >= end * (1 - 1e-9)
    return LateFrames.of(run.truth, second_half(run.truth.times, end), run.turnover) if reached else None


def invariant_divergence(model: Sequence[Invariants], flow: Invariants) -> float:
    """Forward KL divergence of the joint PDFs of Q and R, of all frames of the model together, each in units of its own
    <Q_w>."""
    true_plane, *planes = (found.normalized(found.scale) for found in (flow, *model))
    bins = InvariantBins.covering(*true_plane)
    return kl_divergence(bins.probabilities(*true_plane), bins.probabilities(*np.concatenate(planes, axis=1)))


def section(run: Rollout, span: StationarySpan) -> Section:
    """A forced rollout beside the stationary state of a ground truth whose filter width is known."""
    title = "Forced rollout beside the stationary state"
    try:
        found, turnover = ForcedStatistics.of(run, span), run.turnover
    except ValueError as error:
        return Section("forced", title, notices=[f"It is not compared: {error}."])
    energy, flow_energy, error = found.model.averages("energy", "model"), found.flow_energy, found.spectrum_error
    begin, count = run.model.times[found.late[0]], len(found.model.blocks.members)
    shown = Section(
        "forced", title,
        f"The model is forced with a power of {float(run.attributes['injection_rate']):.3g} a mass. Its averages, from "
        f"{begin / turnover:.3g} to {found.times[-1] / turnover:.3g} T, beside those of the filtered flow over the "
        f"{span.turnovers:.3g} turnovers in which it was stationary. Standard errors are those of blocks of a turnover "
        f"or more, {count} of the model: frames closer than that are no independent samples. PDFs are compared with "
        "those of the true tracers at the start, each in units of its own standard deviation.",
        metrics=[
            Metric("energy", "kinetic energy", {
                **energy, "stationary flow": flow_energy.value, "its standard error": flow_energy.error,
                "its deviation": found.flow_deviation}),
            Metric("acceleration_rms", "rms of an acceleration component", {
                **found.model.averages("acceleration_rms", "model"), "flow at the start": found.flow_acceleration_rms}),
            Metric("spectrum_error", "error of the mean spectrum, rms of ln(E/E_filtered) over 1 ≤ k ≤ k_d",
                   {"model": error.value, "standard error": error.error}),
            Metric("velocity_kl", "KL divergence of the velocity PDF, standardised", found.divergence("velocity")),
            Metric("acceleration_kl", "KL divergence of the acceleration PDF, standardised",
                   found.divergence("acceleration")),
            Metric("qr_kl", "KL divergence of the Q–R joint PDF, standardised", found.qr_kl, WITHOUT_KERNEL),
        ])
    if found.truth is not None:
        shown.metrics += [Metric(f"true_{name}", f"the same of the true tracers at these times: {words}",
                                 found.truth.averages(name, "true tracers"))
                          for name, words in (("energy", "energy"), ("acceleration_rms", "acceleration"))]
    shown.add_figure(
        "forced", "Forced rollout", forced_rollout(found, turnover, run.filter_wavenumber),
        f"Energy of the model {_shown(found.model.blocks.mean(found.model.energy))}, of the stationary flow "
        f"{_shown(flow_energy)} (± is the standard error; band: standard deviation in time). "
        f"Rms of ln(E/E_filtered) of the mean spectra up to k_d (dotted): "
        f"{_shown(error)}. KL of the acceleration PDF {found.divergence('acceleration'):.2g}.")
    return shown


def _shown(found: Estimate) -> str:
    return f"{found.value:.3g} ± {found.error:.2g}" if np.isfinite(found.error) else f"{found.value:.3g}"


@styled
def forced_rollout(found: ForcedStatistics, turnover: float, cutoff: float) -> Figure:
    """Energy over time, mean spectra and acceleration PDFs of the model and of the stationary flow."""
    figure, axes = panels(1, 3, (3.7, 3.2))
    energy, spectra, accelerations = axes.flat
    mean, deviation = found.flow_energy.value, found.flow_deviation
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
