"""Figure of a model on another flow than it was trained on: a-priori errors over the Mach number (Fig. 3 b)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter

from eddies.report.figures import DNS, GUIDE, MODEL, legend_below, panels, styled
from eddies.report.page import Metric, Section

CURVES = (  # column of the table, label, colour, marker, factor that sets the bars apart
    ("acceleration_error", "model", MODEL, "o", 0.99),
    ("pressure_gradient_error", "exact filtered pressure gradient", DNS, "s", 1.01),
)


@dataclass(frozen=True)
class FlowErrors:
    """A model's errors on a flow: what it is called, its M_t when the tracers start (None: not known), the table."""

    name: str
    mach: float | None
    table: Mapping[str, np.ndarray]

    def unseen(self, column: str) -> np.ndarray:
        """Errors at the times after what the model was trained on."""
        return self.table[column][self.table["delay"] > 0]


@styled
def over_mach(flows: Sequence[FlowErrors]) -> Figure:
    """Mean error over the unseen times of each flow, with bars from the smallest to the largest."""
    figure, axes = panels(1, 1, (5.2, 4.0))
    axis, flows = axes[0, 0], sorted(flows, key=lambda flow: flow.mach)
    mach = np.array([flow.mach for flow in flows])
    for column, label, colour, marker, apart in CURVES:
        if any(column not in flow.table for flow in flows):
            continue
        errors = [flow.unseen(column) for flow in flows]
        mean = np.array([each.mean() for each in errors])
        spread = np.array([[each.mean() - each.min(), each.max() - each.mean()] for each in errors]).T
        axis.errorbar(apart * mach, mean, spread, color=colour, marker=marker, markersize=5, capsize=3, linewidth=1.2,
                      label=label)
    axis.axhline(1, color=GUIDE, linestyle=":", linewidth=1.2)
    axis.annotate("no model", (1, 1), xycoords=("axes fraction", "data"), xytext=(-2, -11), ha="right", fontsize=9,
                  textcoords="offset points", color="#5a5a5a")
    for index, flow in enumerate(flows):
        axis.annotate(flow.name, (flow.mach, 0.02 + 0.06 * index), xycoords=("data", "axes fraction"), ha="center",
                      fontsize=9, color="#5a5a5a")
    axis.set(title="A-priori error", xlabel="turbulent Mach number $M_t$", ylabel="normalised L2, acceleration",
             xscale="log", xlim=(0.7 * mach[0], mach[-1] / 0.7), ylim=(0, 1.1))
    axis.xaxis.set_major_locator(FixedLocator(0.01 * 2.0 ** np.arange(8)))
    axis.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.xaxis.set_minor_locator(NullLocator())
    legend_below(axis, 2)
    return figure


def add(shown: Section, this: FlowErrors, source: FlowErrors) -> None:
    """The figure and the numbers of a model whose weights come from another flow; a notice if they are not known."""
    if None in (this.mach, source.mach) or not len(source.unseen("acceleration_error")):
        shown.notices.append(f"{source.name} or this flow has no Mach number, or {source.name} holds no error at an "
                             "unseen time: no figure over the Mach number; train it again, with a window below 1.")
        return
    shown.metrics += [
        Metric("mach_turbulent", "turbulent Mach number M_t", this.mach),
        Metric("source_mach_turbulent", "M_t of the flow that the model was trained on", source.mach),
        Metric("source_acceleration_error", "mean acceleration error at unseen times of that flow",
               float(source.unseen("acceleration_error").mean())),
        Metric("unseen_acceleration_error", "the same of this flow", float(this.unseen("acceleration_error").mean()))]
    shown.add_figure(
        "figure-3b-mach", "A-priori error over the Mach number (the paper's Fig. 3)", over_mach([this, source]),
        f"Trained in {source.name} at M_t = {source.mach:.3f}; of this flow, at M_t = {this.mach:.3f}, the model has "
        "nothing but the scales. Points: mean over the unseen times of a flow; bars: smallest and largest.")
