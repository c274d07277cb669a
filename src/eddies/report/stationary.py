"""The report section on the stationary state of forced turbulence: averages, and values from the literature."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eddies.analysis.isotropic_turbulence import (COMPONENTS, INERTIAL, KOLMOGOROV_CONSTANT, Row, StationarySpan,
                                                  comparison)
from eddies.report.figures import (BLUE, DNS, FOURTH, GUIDE, MODEL, SECOND, legend_below, letter, number_wavenumbers,
                                   panels, styled)
from eddies.report.page import Section

HISTORY = (("dissipation_rate", r"dissipation", BLUE, "-"), ("injection_rate", "injection", FOURTH, "--"))


@styled
def stationary_state(statistics: Mapping[str, np.ndarray], span: StationarySpan) -> Figure:
    """Draw the energy balance and the energy of each velocity component over turnovers, and the compensated spectrum.

    statistics: columns (samples,) of the whole run. span: its stationary part, over which the spectrum is averaged.
    """
    figure, axes = panels(1, 3, (3.6, 3.3), below=0.22)
    turnovers, (first, last) = statistics["turnovers"], span.columns["turnovers"][[0, -1]]
    balance, components, spectrum = axes.flat
    balance.plot(turnovers, statistics["energy"], color=DNS, label="energy")
    for column, label, colour, style in HISTORY:
        balance.plot(turnovers, statistics[column], color=colour, linestyle=style, label=label)
    balance.set(title="Energy balance", ylabel="energy, energy rates", ylim=(0, None))
    for name, colour in zip(COMPONENTS, (BLUE, MODEL, SECOND)):
        share = statistics[name] / np.mean([statistics[other] for other in COMPONENTS], axis=0)
        components.plot(turnovers, share, color=colour, label=f"$u_{name[-1]}$")
    components.axhline(1, color=GUIDE, linestyle="--", linewidth=1.1)
    components.set(title="Components", ylabel="energy / mean of components")
    for axis in (balance, components):
        axis.axvspan(first, last, color=GUIDE, alpha=0.2, linewidth=0)
        axis.set_xlabel("large-eddy turnovers")
        axis.margins(x=0.02)
        legend_below(axis, 3)
    draw_compensated(spectrum, {None: (span, DNS)})
    letter(axes.flat)
    return figure


def draw_compensated(axis: Axes, spans: Mapping[str | None, tuple[StationarySpan, str]]) -> None:
    """Draw the compensated mean spectrum of each span, and a band for Kolmogorov's constant.

    spans: for each label in the legend, a span and the colour of its curve. A curve with the label None is not in the
    legend.
    """
    for label, (span, colour) in spans.items():
        k_eta, compensated = span.compensated_spectrum()
        axis.loglog(k_eta, compensated, color=colour, marker="o", markersize=3, label=label)
    axis.fill_between(INERTIAL, *KOLMOGOROV_CONSTANT, color=GUIDE, alpha=0.6, linewidth=0,
                      label="{}–{}, high Re".format(*KOLMOGOROV_CONSTANT))
    axis.legend(loc="lower left")
    axis.set(title="Compensated spectrum", xlabel=r"$k\,\eta$", ylabel=r"$\varepsilon^{-2/3}k^{5/3}E(k)$",
             ylim=(0.05, 4))
    number_wavenumbers(axis)


def section(statistics: Mapping[str, np.ndarray], span: StationarySpan) -> Section:
    """Return the section with averages over the span, and with values from the literature at the same Re_lambda.

    statistics: columns (samples,) of the whole run.
    """
    (first, last), rows = span.columns["time"][[0, -1]], comparison(span)
    numbers = {row.key: columns_of(row) for row in rows}
    shown = Section(
        "stationary", "Stationary turbulence",
        f"Averages over {span.turnovers:.3g} large-eddy turnovers of the forced flow, t = {first:.3g} to {last:.3g}. "
        "Standard errors are those of blocks of a turnover or more, because closer frames are not independent samples. "
        "Deviations are standard deviations in time. Literature: values at this Re_λ.",
        numbers, {row.key: row.label for row in rows}, columns={
            title: {key: values[title] for key, values in numbers.items() if title in values}
            for title in dict.fromkeys(title for values in numbers.values() for title in values)})
    shown.add_figure(
        "stationary", "The stationary state", lambda: stationary_state(statistics, span),
        f"Shaded: the span of the averages. The energy balance closes to {abs(span.energy_imbalance):.1e} of the "
        "dissipation. C: mean spectrum from the mean energy of the modes of each shell. Band: Kolmogorov's constant.")
    return shown


def columns_of(row: Row) -> dict[str, float | str]:
    """Return the values of a row of the table, by the titles of the columns. Missing values are left out."""
    columns = {"this run": row.value, "standard error": row.error, "deviation": row.deviation,
               "literature": row.literature, "source": row.source}
    return {name: value for name, value in columns.items() if value not in (None, "")}
