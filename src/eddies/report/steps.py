"""The report section on the search for the time step of a rollout."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from eddies.report.figures import GUIDE, legend_at_foot, letter, panels, plain_log_ticks, styled
from eddies.report.page import Metric, Section

NO_CHANGE = 1e-16  # drawn for a change of 0, which a logarithmic axis cannot show

# For each integrator, the columns (trials,) of its test rollouts. Each trial has half the step of the previous one.
Trials = Mapping[str, Mapping[str, np.ndarray]]


def section(found: Mapping[str, float | str], trials: Trials) -> Section:
    """Return the section with the chosen step, all trials and the cost of the search.

    found: attributes of the group `found` of step.h5, on the chosen step and on the search.
    """
    size = "Courant number" if found["integrator"] == "etdrk4" else "time step"
    metrics = [Metric(f"{name}_{step:.4g}", f"{name}, {size} {step:.4g}", {
        "error": error, "change from twice the step": change, "seconds a turnover": seconds})
        for name, columns in trials.items()
        for step, error, change, seconds in zip(*(columns[key] for key in (
            "size", "error", "difference", "seconds_per_turnover")))]
    shown = Section(
        "step", f"Step: {found['integrator']}, {size} {found['size']:.4g}",
        f"Test rollouts of {found['turnovers']:.2g} turnovers on the ground truth; no stability limit shortens their "
        "steps. A step has converged if it adds less than 2 % to the error of the final velocities: halving it must "
        f"change them by less than {found['tolerance']:.2g} of their rms. The cheapest converged step is chosen. It "
        f"takes {found['seconds_per_turnover']:.3g} s per turnover. Its error is {found['error']:.4f}; the error with "
        f"half the step is {found['error_with_half']:.4f}. The search took {found['seconds']:.3g} s.", metrics=metrics)
    shown.add_figure("step", "Convergence in the step", convergence(found, trials, size),
                     "Circle: the chosen step. Dashed: the largest change of a converged step.")
    return shown


@styled
def convergence(found: Mapping[str, float | str], trials: Trials, size: str) -> Figure:
    """Draw two panels: the change of the final velocities when the step is halved, and the error over the run time.

    found: see `section`. size: the label of the axis of steps, "time step" or "Courant number".
    """
    figure, ((change, error),) = panels(1, 2, (4.6, 3.1), foot=0.3)
    for name, columns in trials.items():
        changes = np.maximum(columns["difference"][1:], NO_CHANGE)
        change.loglog(columns["size"][:-1], changes, marker="o", markersize=3, label=name)
        error.loglog(columns["seconds_per_turnover"], columns["error"], marker="o", markersize=3)
    change.axhline(found["tolerance"], color=GUIDE, linestyle="--", linewidth=1.1)
    for panel, place in ((change, (found["size"], max(found["difference"], NO_CHANGE))),
                         (error, (found["seconds_per_turnover"], found["error"]))):
        panel.plot(*place, marker="o", markersize=9, fillstyle="none", color="black")
    change.set(title="Change by halving the step", xlabel=size, ylabel="rms change / rms velocity")
    error.set(title="Error over run time", xlabel="seconds per turnover", ylabel="rms error / rms velocity")
    plain_log_ticks(change.xaxis, error.xaxis, error.yaxis)
    for axis in (change.xaxis, change.yaxis, error.xaxis, error.yaxis):  # room: trials may be close to each other
        low, high = axis.get_data_interval()
        axis.set_view_interval(low / 2, high * 2, ignore=True)
    legend_at_foot(figure, change, 5)
    letter((change, error))
    return figure
