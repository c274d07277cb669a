"""The report's part on the step of a rollout: what short rollouts say of each, and which is taken."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

from eddies.report.figures import GUIDE, letter, panels, styled
from eddies.report.page import Metric, Section

# What stands for no change at all, as of a method whose steps are exact, on an axis of logarithms.
NO_CHANGE = 1e-16


@styled
def convergence(found: Mapping[str, float | str], trials: Mapping[str, Mapping[str, np.ndarray]], size: str) -> Figure:
    """Change by halving the step, and seconds of a turnover, over the step, for each integrator.

    trials: columns (trials,) by integrator, each with half the step of the one before.
    """
    figure, ((change, cost),) = panels(1, 2, (4.6, 3.2))
    for name, columns in trials.items():
        changes = np.maximum(columns["difference"][1:], NO_CHANGE)
        change.loglog(columns["size"][:-1], changes, marker="o", markersize=3, label=name)
        cost.loglog(columns["size"], columns["seconds_per_turnover"], marker="o", markersize=3)
    change.axhline(found["tolerance"], color=GUIDE, linestyle="--", linewidth=1.1)
    for axis, value in ((change, max(found["difference"], NO_CHANGE)), (cost, found["seconds_per_turnover"])):
        axis.plot(found["size"], value, marker="o", markersize=9, fillstyle="none", color="black")
    change.set(title="Change by halving the step", xlabel=size, ylabel="rms change / rms velocity")
    cost.set(title="Cost", xlabel=size, ylabel="seconds a turnover")
    for axis in (change, cost):
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.xaxis.set_minor_locator(NullLocator())
    figure.legend(*change.get_legend_handles_labels(), loc="outside lower center", ncols=5)
    letter((change, cost))
    return figure


def section(found: Mapping[str, float | str], trials: Mapping[str, Mapping[str, np.ndarray]]) -> Section:
    """The step that was found, the rows of all trials, and what finding it cost."""
    size = "Courant number" if found["integrator"] == "etdrk4" else "time step"
    metrics = [Metric(f"{name}_{step:.4g}", f"{name}, {size} {step:.4g}", {
        "error": error, "change from twice the step": change, "seconds a turnover": seconds})
        for name, columns in trials.items()
        for step, error, change, seconds in zip(*(columns[key] for key in (
            "size", "error", "difference", "seconds_per_turnover")))]
    shown = Section(
        "step", f"Step: {found['integrator']}, {size} {found['size']:.4g}",
        f"Rollouts of {found['turnovers']:.2g} turnovers on the ground truth, without limits of stability. A step has "
        "converged if halving it changes the velocities at the end by less than a small share of their error: here "
        f"{found['tolerance']:.2g}. The cheapest of these is taken: {found['seconds_per_turnover']:.3g} s a turnover. "
        "Its error is "
        f"{found['error']:.4f}, that of half the step {found['error_with_half']:.4f}. To find it took "
        f"{found['seconds']:.3g} s.", metrics=metrics, folded=True)
    shown.add_figure("step", "Convergence in the step", convergence(found, trials, size),
                     "Circle: the step that is taken. Dashed: the change below which a step has converged.")
    return shown
