"""The report section on a forced rollout: its statistics, and those of the stationary state of the ground truth."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from eddies.analysis.against_truth import EDGES, mean_energy
from eddies.analysis.block_averages import Blocks, Estimate
from eddies.analysis.isotropic_turbulence import StationarySpan
from eddies.analysis.pdfs import bin_centres, bin_probabilities, gaussian, kl_divergence, pdf, standardized
from eddies.analysis.rollout import Frames, Rollout, second_half
from eddies.analysis.errors import spectrum_error
from eddies.analysis.velocity_gradients import InvariantBins, Invariants
from eddies.report.figures import GUIDE, MODEL, TRUTH, letter, number_wavenumbers, panels, styled
from eddies.report.page import Metric, Section
from eddies.report.rollout import WITHOUT_KERNEL
from eddies.spectral.mode_operators import gaussian_transfer

SERIES = {"energy": "kinetic energy", "acceleration_rms": "rms of an acceleration component"}


def averages(run: Frames, frames: np.ndarray, turnover: float, whose: str) -> dict[str, dict[str, float]]:
    """Return statistics over `frames` for each name in SERIES.

    The mean has the text `whose` as its key. The other keys are "standard error", "trend per turnover", "error of the
    trend", and "deviation" for the standard deviation in time.
    """
    blocks, found = Blocks.of(run.times[frames] / turnover, 1.0), {}
    samples = {"energy": np.array([mean_energy(run, frame) for frame in frames]),
               "acceleration_rms": np.array([np.std(run.read(frame, "acceleration")) for frame in frames])}
    for name, values in samples.items():
        mean, slope = blocks.mean(values), blocks.trend(values)
        found[name] = {whose: mean.value, "standard error": mean.error, "trend per turnover": slope.value,
                       "error of the trend": slope.error, "deviation": float(values.std())}
    return found


def invariant_divergence(model: Sequence[Invariants], flow: Invariants) -> float:
    """Return the forward KL divergence between the joint PDFs of Q and R in the flow and in all frames of the model.

    Q and R of each frame are in units of its own <Q_w> and <Q_w>^(3/2).
    """
    true_plane, *planes = (found.normalized(found.scale) for found in (flow, *model))
    bins = InvariantBins.covering(*true_plane)
    return kl_divergence(bins.probabilities(*true_plane), bins.probabilities(*np.concatenate(planes, axis=1)))


def section(run: Rollout, span: StationarySpan) -> Section:
    """Return the section. Averages of the model are over the second half of the time before `run.broken`.

    They are compared with averages over `span`, the stationary state of the ground truth.
    """
    shown, turnover = Section("forced", "Forced rollout beside the stationary state"), run.turnover
    frames = run.before_broken("model")
    if not len(frames):
        shown.notices.append("The rollout is not compared: the model has no finite frame.")
        return shown
    times = run.model.times[frames]
    late = run.late
    model = averages(run.model, late, turnover, "model")
    flow, deviation = filtered_energy(run, span)
    wavenumber, spectra, error = mean_spectra(run, span)
    samples = {column: (standardized(run.truth.read(0, column)),
                        np.concatenate([standardized(run.model.read(frame, column)) for frame in late]))
               for column in ("velocity", "acceleration")}
    divergence = {column: kl_divergence(*(bin_probabilities(values, EDGES[column]) for values in both))
                  for column, both in samples.items()}
    qr_kl = None if run.invariants is None else invariant_divergence(
        [run.invariants["model"][int(frame)] for frame in late], run.invariants["truth"][0])
    shown.text = (
        f"The model is forced with a power of {run.powers[0]:.3g} per mass. Its averages from "
        f"{run.model.times[late[0]] / turnover:.3g} to {times[-1] / turnover:.3g} T are compared with those of the "
        f"filtered flow over {span.turnovers:.3g} turnovers of its stationary state. Standard errors are those of "
        "blocks of a turnover or more, because closer frames are not independent samples. PDFs are compared with those "
        "of the true tracers at the start, each in units of its own standard deviation.")
    shown.metrics = [
        Metric("energy", SERIES["energy"], {
            **model["energy"], "stationary flow": flow.value, "its standard error": flow.error,
            "its deviation": deviation}),
        Metric("acceleration_rms", SERIES["acceleration_rms"], {
            **model["acceleration_rms"], "flow at the start": float(np.std(run.truth.read(0, "acceleration")))}),
        Metric("spectrum_error", "error of the mean spectrum, rms of ln(E/E_filtered) over 1 ≤ k ≤ k_d",
               {"model": error.value, "standard error": error.error}),
        Metric("velocity_kl", "KL divergence of the velocity PDF, standardised", divergence["velocity"]),
        Metric("acceleration_kl", "KL divergence of the acceleration PDF, standardised", divergence["acceleration"]),
        Metric("qr_kl", "KL divergence of the Q–R joint PDF, standardised", qr_kl, WITHOUT_KERNEL)]
    if run.powers[1] > 0 and run.truth.times[-1] >= times[-1] * (1 - 1e-9):
        truth = averages(run.truth, second_half(run.truth.times, times[-1]), turnover, "true tracers")
        shown.metrics += [Metric(f"true_{name}", f"{words}, true tracers over the same time", truth[name])
                          for name, words in SERIES.items()]
    energy = np.array([mean_energy(run.model, frame) for frame in frames])
    mean = Estimate(model["energy"]["model"], model["energy"]["standard error"])
    shown.add_figure(
        "forced", "Forced rollout",
        forced_rollout((times / turnover, energy), (flow.value, deviation), (wavenumber, *spectra),
                       run.filter_wavenumber, samples["acceleration"]),
        f"Energy: model {_shown(mean)}, stationary flow {_shown(flow)} (± standard error; band: standard deviation in "
        f"time). Rms of ln(E/E_filtered) of the mean spectra up to k_d (dotted): {_shown(error)}. KL divergence of the "
        f"acceleration PDF: {divergence['acceleration']:.2g}.")
    return shown


def _transfer(run: Rollout, span: StationarySpan) -> np.ndarray:
    """Return, for each shell, the fraction of its energy that the filter keeps, (shells,)."""
    return gaussian_transfer(np.arange(span.spectra.shape[1]) ** 2, run.filter_width) ** 2


def filtered_energy(run: Rollout, span: StationarySpan) -> tuple[Estimate, float]:
    """Return the mean energy of the filtered flow over its stationary span, and its standard deviation in time."""
    energy = span.spectra @ _transfer(run, span)
    return span.block_mean(energy), span.average(energy)[1]


def mean_spectra(run: Rollout, span: StationarySpan) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray], Estimate]:
    """Return the wavenumbers, the mean spectra of filtered flow and model, and the spectrum error of the model.

    The wavenumbers and each spectrum are (shells,).
    """
    chosen = run.late_spectra()
    spectra = np.array([run.spectra["model"][int(frame)] for frame in chosen])
    known = min(spectra.shape[1], span.spectra.shape[1])
    spectra, flow = spectra[:, :known], (_transfer(run, span) * span.spectrum)[:known]
    blocks = Blocks.of(run.model.times[chosen] / run.turnover, 1.0)
    error = blocks.of_mean(spectra, lambda mean: spectrum_error(mean, flow, run.filter_wavenumber))
    return np.arange(known), (flow, blocks.means(spectra).mean(axis=0)), error


def _shown(found: Estimate) -> str:
    return f"{found.value:.3g} ± {found.error:.2g}" if np.isfinite(found.error) else f"{found.value:.3g}"


@styled
def forced_rollout(series: tuple[np.ndarray, np.ndarray], flow: tuple[float, float],
                   spectra: tuple[np.ndarray, np.ndarray, np.ndarray], cutoff: float,
                   accelerations: tuple[np.ndarray, np.ndarray]) -> Figure:
    """Draw energy over time, mean spectra and acceleration PDFs of the model and of the stationary flow.

    series: time / T and energy of the model. flow: mean and standard deviation of the energy of the flow. spectra:
    wavenumbers, and the spectra of flow and model. cutoff: filter wavenumber k_d. accelerations: those of flow and
    model, standardised.
    """
    figure, ((energy, spectrum, density),) = panels(1, 3, (3.6, 3.1))
    mean, deviation = flow
    energy.axhspan(mean - deviation, mean + deviation, color=TRUTH, alpha=0.2, linewidth=0)
    energy.axhline(mean, color=TRUTH, label="stationary flow")
    energy.plot(*series, color=MODEL, label="forced model")
    energy.set(title="Kinetic energy", xlabel="$t/T$", ylabel=r"$\langle v\cdot v\rangle/2$",
               ylim=(0, 1.15 * max(series[1].max(), mean + deviation)))
    energy.legend(loc="lower left")
    k = spectra[0]
    drawn = (k >= 1) & (k <= 2 * cutoff)
    for values, colour in zip(spectra[1:], (TRUTH, MODEL)):
        spectrum.loglog(k[drawn], values[drawn], color=colour, marker="o", markersize=3)
    spectrum.axvline(cutoff, color=GUIDE, linestyle=":")
    spectrum.set(title="Mean spectrum", xlabel="$k$", ylabel="$E(k)$")
    number_wavenumbers(spectrum)
    edges = EDGES["acceleration"]
    middle = bin_centres(edges)
    for values, colour, label in zip(accelerations, (TRUTH, MODEL), ("true tracers at the start", "forced model")):
        found = pdf(values, edges)
        density.semilogy(middle[found > 0], found[found > 0], color=colour, label=label)
    density.plot(middle, gaussian(middle), color=GUIDE, linestyle="--", linewidth=1.1, label="Gaussian")
    density.set(title="Acceleration PDF", xlabel="$a$ / its standard deviation", ylim=(1e-6, 1))
    density.legend(loc="lower center")
    letter((energy, spectrum, density))
    return figure
