"""The report section on the searches for the time steps of rollouts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from eddies.report.figures import Look, legend_at_foot, letter, panels, plain_log_ticks, styled
from eddies.report.page import Metric, Section, side_by_side

NO_CHANGE = 1e-16  # drawn for a change of 0, which a logarithmic axis cannot show

# For each integrator, the columns (trials,) of its test rollouts. Each trial has half the step of the previous one.
Trials = Mapping[str, Mapping[str, np.ndarray]]


@dataclass(frozen=True)
class Search:
    """The search for the step of a variant: label, colour and marker, and what step.h5 holds.

    found : attributes of the group `found`, on the chosen step and on the search.
    """

    label: str
    look: Look
    found: Mapping[str, float | str]
    trials: Trials

    @property
    def size(self) -> str:
        """What a step is called."""
        return "Courant number" if self.found["integrator"] == "etdrk4" else "time step"

    @property
    def chosen(self) -> list[Metric]:
        """The chosen step, with its error and cost."""
        found = self.found
        return [Metric("integrator", "integrator", found["integrator"]),
                Metric("size", "step (on a grid: Courant number)", found["size"]),
                Metric("error", "error", found["error"]),
                Metric("error_with_half", "error with half the step", found["error_with_half"]),
                Metric("seconds_per_turnover", "seconds per turnover", found["seconds_per_turnover"]),
                Metric("seconds", "seconds of the search", found["seconds"])]

    @property
    def tried(self) -> list[Metric]:
        """The error and the cost of each trial."""
        return [Metric(f"{name}_{step:.4g}", f"{name}, {self.size} {step:.4g}", {
            "error": error, "change from twice the step": change, "seconds a turnover": seconds})
            for name, columns in self.trials.items()
            for step, error, change, seconds in zip(*(columns[key] for key in (
                "size", "error", "difference", "seconds_per_turnover")))]


def section(searches: Mapping[str, Search]) -> Section:
    """Return the section with the chosen steps and the cost of the searches."""
    first = next(iter(searches.values()))
    shown = Section(
        "steps", "Time steps", f"Test rollouts of {first.found['turnovers']:.2g} turnovers on the ground truth; no "
        "stability limit shortens their steps. A step has converged if it adds less than 2 % to the error of the final "
        f"velocities: halving it must change them by less than {first.found['tolerance']:.2g} of their rms. The "
        "cheapest converged step is chosen. All trials are in metrics.json.",
        metrics=side_by_side({each.label: each.chosen for each in searches.values()}), folded=True)
    shown.add_figure("step", "Convergence in the step", lambda: convergence(list(searches.values())),
                     "Trials of the chosen integrator. Circle: the chosen step. Dashed: the largest change of a "
                     "converged step.")
    return shown


@styled
def convergence(searches: Sequence[Search]) -> Figure:
    """Draw two panels: the change of the final velocities when the step is halved, and the error over the run time."""
    figure, ((change, error),) = panels(1, 2, (4.6, 3.1), foot=0.1 + 0.2 * -(-len(searches) // 5))
    for each in searches:
        found, columns, (colour, marker) = each.found, each.trials[each.found["integrator"]], each.look
        changes = np.maximum(columns["difference"][1:], NO_CHANGE)
        line = {"color": colour, "marker": marker, "markersize": 4}
        change.loglog(columns["size"][:-1], changes, label=f"{each.label}: {found['integrator']}", **line)
        error.loglog(columns["seconds_per_turnover"], columns["error"], **line)
        change.axhline(found["tolerance"], color=colour, linestyle="--", linewidth=0.8)
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
    legend_at_foot(figure, change, min(len(searches), 4))
    letter((change, error))
    return figure
