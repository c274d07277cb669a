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
    """Change by halving the step over the step, and the error over the seconds of a turnover, for each integrator.

    trials: columns (trials,) by integrator, each with half the step of the one before.
    """
    figure, ((change, error),) = panels(1, 2, (4.6, 3.2))
    for name, columns in trials.items():
        changes = np.maximum(columns["difference"][1:], NO_CHANGE)
        change.loglog(columns["size"][:-1], changes, marker="o", markersize=3, label=name)
        error.loglog(columns["seconds_per_turnover"], columns["error"], marker="o", markersize=3)
    change.axhline(found["tolerance"], color=GUIDE, linestyle="--", linewidth=1.1)
    for panel, place in ((change, (found["size"], max(found["difference"], NO_CHANGE))),
                         (error, (found["seconds_per_turnover"], found["error"]))):
        panel.plot(*place, marker="o", markersize=9, fillstyle="none", color="black")
    change.set(title="Change by halving the step", xlabel=size, ylabel="rms change / rms velocity")
    error.set(title="Error over run time", xlabel="seconds a turnover", ylabel="rms error / rms velocity")
    for axis in (change.xaxis, error.xaxis, error.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.set_minor_locator(NullLocator())
    for axis in (change.xaxis, change.yaxis, error.xaxis, error.yaxis):  # a few trials may lie close to each other
        low, high = axis.get_data_interval()
        axis.set_view_interval(low / 2, high * 2, ignore=True)
    figure.legend(*change.get_legend_handles_labels(), loc="outside lower center", ncols=5)
    letter((change, error))
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
        "converged if it adds less than 2 % to the error of the final velocities. Halving it may change them by "
        f"{found['tolerance']:.2g}. The cheapest of these is taken: {found['seconds_per_turnover']:.3g} s a "
        f"turnover. Its error is {found['error']:.4f}, that of half the step {found['error_with_half']:.4f}. "
        f"To find it took {found['seconds']:.3g} s.", metrics=metrics, folded=True)
    shown.add_figure("step", "Convergence in the step", convergence(found, trials, size),
                     "Circle: the step that is taken. Dashed: the change below which a step has converged.")
    return shown
