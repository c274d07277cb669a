"""The report section on the searches for the time steps of rollouts."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from eddies.parallel.step_times import was_busy
from eddies.report.figures import Variant, legend_at_foot, letter, panels, plain_log_ticks, styled
from eddies.report.page import Section

NO_CHANGE = 1e-16  # drawn for a change of 0, which a logarithmic axis cannot show
CHOSEN = "integrator", "size", "error", "error_with_half", "seconds_per_turnover", "seconds"
LABELS = {"size": "step (on a grid: Courant number)", "seconds": "seconds of the search"}


def numbers_of(search: Variant) -> dict[str, Any]:
    """Return the chosen step of a search with its error and cost, whether the machine was busy, and the trials."""
    return {**{key: search.numbers[key] for key in CHOSEN}, "busy": was_busy(search.numbers), **{f"{name}_{step:.4g}": {
        "error": error, "change from twice the step": change, "seconds a turnover": seconds}
        for name, columns in search.tables.items()
        for step, error, change, seconds in zip(*(columns[key] for key in (
            "size", "error", "difference", "seconds_per_turnover")))}}


def section(searches: Sequence[Variant]) -> Section:
    """Return the section with the chosen steps and the cost of the searches.

    The numbers of a variant are the attributes of the group `found` in step.h5, on the chosen step and on the search.
    Its tables hold the columns (trials,) of the test rollouts of each integrator. Each trial has half the step of the
    previous one.
    """
    found = searches[0].numbers
    shown = Section(
        "steps", "Time steps", f"Test rollouts of {found['turnovers']:.2g} turnovers on the ground truth; no "
        "stability limit shortens their steps. A step has converged if it adds less than 2 % to the error of the final "
        f"velocities: halving it must change them by less than {found['tolerance']:.2g} of their rms. The "
        "cheapest converged step is chosen. All trials are in metrics.json.", labels=LABELS,
        columns={each.label: {key: each.numbers[key] for key in CHOSEN} for each in searches})
    shown.add_figure("step", "Convergence in the step", lambda: convergence(searches),
                     "Trials of the chosen integrator. Circle: the chosen step. Dashed: the largest change of a "
                     "converged step.")
    return shown


@styled
def convergence(searches: Sequence[Variant]) -> Figure:
    """Draw two panels: the change of the final velocities when the step is halved, and the error over the run time."""
    figure, ((change, error),) = panels(1, 2, (4.6, 3.1))
    for each in searches:
        found, columns = each.numbers, each.tables[each.numbers["integrator"]]
        line = {**each.line(columns), "label": f"{each.label}: {found['integrator']}"}
        change.loglog(columns["size"][:-1], np.maximum(columns["difference"][1:], NO_CHANGE), **line)
        error.loglog(columns["seconds_per_turnover"], columns["error"], **line)
        change.axhline(found["tolerance"], color=each.look[0], linestyle="--", linewidth=0.8)
        for panel, place in ((change, (found["size"], max(found["difference"], NO_CHANGE))),
                             (error, (found["seconds_per_turnover"], found["error"]))):
            panel.plot(*place, marker="o", markersize=9, fillstyle="none", color="black")
    change.set(title="Change by halving the step", xlabel="time step, or Courant number of a grid",
               ylabel="rms change / rms velocity")
    error.set(title="Error over run time", xlabel="seconds per turnover", ylabel="rms error / rms velocity")
    plain_log_ticks(change.xaxis, error.xaxis)
    for axis in (change.xaxis, change.yaxis, error.xaxis, error.yaxis):  # room: trials may be close to each other
        low, high = axis.get_data_interval()
        axis.set_view_interval(low / 2, high * 2, ignore=True)
    legend_at_foot(figure, change)
    letter((change, error))
    return figure
