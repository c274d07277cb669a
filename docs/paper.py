"""Draws the figures of paper.md from four runs: the flow of the training, and unseen ones at three Mach numbers.

    .venv/bin/python docs/paper.py training=runs/paper-256 mt008=runs/paper-256-unseen mt016=runs/paper-256-mt016 \
        mt004=runs/paper-256-mt004

Numbers of figures are those of the paper. Figures 4 to 7 show mt008, Fig. 8 mt008 and, if it is given, mt016.
Figures of runs that are not given are left as they are; Fig. 3 takes their numbers from
results/paper-a-priori.json, and tables of paper.md from results/paper-NAME.json, which are written here.
"""

import json
import sys
from pathlib import Path

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from mpi4py import MPI
from pictures import save
from tables import keep

from eddies import open_run
from eddies.analysis.pdfs import bin_centres, bin_probabilities, gaussian, kl_divergence, pdf, standardized
from eddies.flow.statistics import energy_spectrum
from eddies.parallel.slab import SlabDecomposition
from eddies.report.figures import (DNS, FILTERED, GUIDE, LOOKS, OTHERS, TRUTH, Variant, legend_at_foot, letter,
                                   note, panels, plain_log_ticks, styled)
from eddies.report.models import EDGES
from eddies.report.rollout_figures import (OUTER_BINS, invariant_planes, particle_pdfs, turnover_of, velocity_planes,
                                           vorticity_and_energy)
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.stored_run import StoredRun
from eddies.workflows import measure

HERE = Path(__file__).parent / "paper"
# Variants in the figures: label, colour and marker.
MODELS = {"paper-forced": ("paper, forced", OTHERS[0]), "paper": ("paper", LOOKS["paper"]),
          "resolved": ("resolved", LOOKS["resolved"]), "local": ("local", LOOKS["local"])}
SHADE = "#e4e4e4"
# Lines of the PDFs of accelerations in Fig. 3: of the truth, of the published model, and for comparison.
PDFS = ({"color": TRUTH, "label": "true accelerations"},
        {"color": LOOKS["paper"][0], "linestyle": "none", "marker": "o", "markersize": 3, "markerfacecolor": "none",
         "label": "accelerations of paper"},
        {"color": GUIDE, "linestyle": ":", "label": "Gaussian"})
NAMES = "training", "mt008", "mt016", "mt004"
RESULTS = Path(__file__).parent / "results"
NUMBERS = RESULTS / "paper-a-priori.json"
MOMENTS = {"quarter": 0.25, "half": 0.5, "end": 1.0}  # parts of a turnover, of which the text has numbers


def mach_number(run: StoredRun) -> float:
    """M_t of the flow when the tracers are released."""
    return run.metrics["ground_truth"]["mach_turbulent"]


def numbers_of(run: StoredRun) -> dict:
    """What Fig. 3 shows of a run: errors at the true state over time, and PDFs of accelerations at the last time."""
    tables = {name: run.variant(name)["model/a_priori"] for name in ("paper", "resolved", "local")}
    sample = run.variant("paper")["model/acceleration_sample"]
    truth, predicted = (standardized(np.asarray(sample[name]), np.asarray(sample["truth"])) for name in (
        "truth", "predicted"))
    own = tables["paper"]
    return {"mach": mach_number(run), "delay": own["delay"].values.tolist(),
            "pressure_gradient": own["pressure_gradient_error"].values.tolist(),
            "models": {name: table["acceleration_error"].values.tolist() for name, table in tables.items()},
            "pdfs": [pdf(values, EDGES).tolist() for values in (truth, predicted)],
            "divergence": kl_divergence(*(bin_probabilities(values, EDGES) for values in (truth, predicted)))}


@styled
def figure_3(numbers: dict[str, dict]):
    """Draw errors at the true state over delay and Mach number, and PDFs of the acceleration."""
    figure, axes = panels(2, 3, (3.6, 2.9))
    delay, machs, *shown = axes.flat
    training = numbers["training"]
    for name in training["models"]:
        label, (colour, marker) = MODELS[name]
        line = {"color": colour, "marker": marker, "markersize": 4, "label": label}
        delay.plot(training["delay"], training["models"][name], **line)
        found = sorted((each["mach"], np.mean(each["models"][name])) for key, each in numbers.items()
                       if key != "training")
        machs.plot(*np.transpose(found), **line)
    delay.plot(training["delay"], training["pressure_gradient"], color=GUIDE, label="exact filtered pressure gradient")
    delay.axvspan(min(training["delay"]), 0, color=SHADE)
    delay.set(xlabel="time after the training interval", ylabel="acceleration error", ylim=(0, None),
              title="flow of the training")
    machs.set(xlabel="$M_t$", ylim=(0, None), title="unseen flows, mean over time")
    for axis, (key, each) in zip(shown, numbers.items()):
        for density, line in zip(np.array(each["pdfs"]), PDFS):
            axis.semilogy(bin_centres(EDGES), np.where(density > 0, density, np.nan), **line)
        axis.semilogy(bin_centres(EDGES), gaussian(bin_centres(EDGES)), **PDFS[-1])
        seen = "training flow, later" if key == "training" else "unseen"
        axis.set(title=f"$M_t = {each['mach']:.2f}$, {seen}", xlabel="$a$ / standard deviation", ylim=(1e-5, 2),
                 ylabel="PDF")
    for axis in shown[len(numbers):]:
        axis.remove()
    note(shown[0], OUTER_BINS, (0, 1), "axes fraction", (3, -10), fontsize=8)
    legend_at_foot(figure, [*delay.get_legend_handles_labels()[0], Patch(color=SHADE, label="interval of the training"),
                            *(Line2D([], [], **line) for line in PDFS)])
    letter([*axes.flat][:2 + len(numbers)])
    return figure


def drawn(run: Path, names: list[str]) -> list[Variant]:
    """The measures of variants of a run, which are made if they are missing."""
    for name in names:
        measure.update(run / name, MPI.COMM_SELF)
    return [Variant(*MODELS[name], *measure.read(run / name, MPI.COMM_SELF)) for name in names]


def over_time(found: Variant) -> dict[str, float]:
    """Divergences, energy over the true one, and variance of counts of a rollout at parts of a turnover that it
    reached."""
    tables, turnover, numbers = found.tables, turnover_of([found]), {}
    errors, model, truth = (tables[name] for name in ("errors", "model", "truth"))
    for moment, part in MOMENTS.items():
        row = int(np.argmin(np.abs(errors["time"] - part * turnover)))
        if errors["time"][row] > (part - 0.05) * turnover:  # else the rollout has broken off
            numbers |= {f"velocity_kl_{moment}": errors["velocity_kl"][row],
                        f"acceleration_kl_{moment}": errors["acceleration_kl"][row],
                        f"energy_ratio_{moment}": model["energy"][row] / truth["energy"][row],
                        f"count_variance_{moment}": model["count_variance"][row]}
    return {key: float(f"{value:.5g}") for key, value in numbers.items()}


def add(name: str, rollouts: list[Variant]) -> None:
    """Add the numbers over time to the rows of the results of a run."""
    path = RESULTS / f"{name}.json"
    record = json.loads(path.read_text(encoding="utf-8"))
    found = dict(zip(MODELS, map(over_time, rollouts)))
    for row in record["rows"]:
        row |= found.get(row["name"], {})
    path.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


@styled
def figure_8(rows: list[tuple[str, list[Variant], list[StoredRun]]]):
    """Draw energy spectra up to k_d over those of the true tracers, at the times of the rollouts' spectra; a row for
    each flow.

    Spectra of particles are those of the field that the learned kernel reconstructs, as in the paper.
    """
    times = len(rows[0][1][0].tables["flow_spectra"]["time"])
    figure, axes = panels(len(rows), times, (3.5, 3.1), sharex=True, sharey=True)
    for row, (title, rollouts, stored) in zip(axes, rows):
        flow, cutoff = rollouts[0].tables["flow_spectra"], rollouts[0].numbers["rollout"]["filter_wavenumber"]
        shown = np.arange(1, int(cutoff) + 1)
        for number, (axis, time) in enumerate(zip(row, flow["time"])):
            truth = spectrum(stored[0].field(time=time, of="truth"))[shown]
            axis.axhline(1, color=TRUTH, linewidth=1.2, label="true tracers")
            for column, line in (("energy_flow", {"color": DNS, "linestyle": ":", "label": "DNS"}),
                                 ("energy_filtered", {"color": FILTERED, "label": "filtered DNS"})):
                axis.plot(shown, flow[column][number][shown] / truth, linewidth=1.2, **line)
            for each, run in zip(rollouts, stored):
                axis.plot(shown, spectrum(run.field(time=time, of="model"))[shown] / truth,
                          **{**each.line(each.tables["spectra"]), "markevery": 1})
            axis.set_title(f"{title}, $t = {time / turnover_of(rollouts):.2f}\\,T$")
        row[0].set(ylabel="$E(k)$ / true tracers", yscale="log")
        plain_log_ticks(row[0].yaxis)
    for axis in axes[-1]:
        axis.set(xlabel="wavenumber $k$", xticks=shown)
    legend_at_foot(figure, axes[0, 0])
    letter(axes.flat)
    return figure


def spectrum(field) -> np.ndarray:
    """The spectrum of a field (3, n, n, n), summed over shells of unit width."""
    cells = field.shape[-1]
    grid = SpectralGrid(SlabDecomposition(MPI.COMM_SELF, 2 * np.pi, cells), cutoff=(cells - 1) // 2)
    return energy_spectrum(grid, grid.forward(np.asarray(field, dtype=float)))


def main(arguments: list[str]) -> None:
    """Draw the figures of the runs that are given as NAME=RUN, and write their numbers."""
    runs = {name: open_run(path) for name, path in (argument.split("=") for argument in arguments)}
    numbers = json.loads(NUMBERS.read_text(encoding="utf-8")) if NUMBERS.exists() else {}
    numbers |= {name: numbers_of(run) for name, run in runs.items()}
    numbers = {name: numbers[name] for name in NAMES if name in numbers}
    NUMBERS.write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")
    rollouts = {name: drawn(run.path, [*MODELS]) for name, run in runs.items() if name != "training"}
    for name, found in rollouts.items():
        keep(f"paper-{name}", runs[name].path)
        add(f"paper-{name}", found)
    save(HERE / "figure-3.png", figure_3(numbers))
    if "training" in runs:
        shown = runs["training"].figures
        save(HERE / "figure-1.png", shown["figure-1-kernels"])
        save(HERE / "figure-2.png", shown["figure-2-reconstruction"])
    if "mt008" not in runs:
        return
    for number, draw in ((4, velocity_planes), (5, vorticity_and_energy), (6, particle_pdfs), (7, invariant_planes)):
        save(HERE / f"figure-{number}.png", draw(rollouts["mt008"]))
    save(HERE / "figure-8.png", figure_8([(f"$M_t = {mach_number(runs[name]):.2f}$", rollouts[name],
                                           [runs[name].variant(variant) for variant in MODELS])
                                          for name in ("mt008", "mt016") if name in runs]))


if __name__ == "__main__":
    main(sys.argv[1:])
