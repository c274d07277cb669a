"""The page of a comparison: error against run time, with what nothing else beats, and all numbers in tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

from eddies.analysis.pareto import cheapest_grid, pareto_front, verdict
from eddies.measures import DRAWN, MEASURES, SHOWN, is_error
from eddies.report.figures import DNS, FILTERED, FOURTH, GUIDE, MODEL, SECOND, THIRD, TRUTH, letter, panels, styled
from eddies.report.labels import fix_layout, place_labels
from eddies.report.page import Metric, RunRecord, Section

Row = Mapping[str, Any]

COST = "wall_seconds"
LOOKS = list(zip((MODEL, TRUTH, SECOND, FOURTH, THIRD, DNS, FILTERED), "os^DvPX"))
# Columns of the tables of the page: key in the rows, words. Measures come before them.
COSTS = {"wall_seconds": "wall s per T", "wall_seconds_low": "lower quartile", "wall_seconds_high": "upper quartile",
         "core_seconds": "core s per T", "seconds_per_step": "s per step", "time_step": "time step",
         "training_seconds": "training (s)"}


@dataclass(frozen=True)
class ErrorAgainstTime:
    """What is drawn: a row of numbers by key for every variant, None where there is none.

    subject: name of the variant that the summary is about; baselines: the group that it is measured against; columns:
    the measures that are asked for, if any are.
    """

    rows: Sequence[Row]
    subject: str
    baselines: str
    columns: Sequence[str] | None = None

    @property
    def measures(self) -> dict[str, str]:
        """Those of the table, with their words."""
        return {name: MEASURES[name] for name in self.columns or SHOWN}

    @property
    def drawn(self) -> list[str]:
        """Those of the figures: what is asked for and an error."""
        return [name for name in self.columns or DRAWN if is_error(name)]

    @property
    def looks(self) -> dict[str, tuple[str, str]]:
        """Colour and marker of every group, in order of appearance."""
        groups = dict.fromkeys(row["group"] for row in self.rows)
        return {group: LOOKS[number % len(LOOKS)] for number, group in enumerate(groups)}

    @property
    def summary(self) -> list[str]:
        """Where the subject is worth its cost, where it is not, and which grid, if there are any, would do; what became
        unstable counts as without numbers."""
        numbers = [row if is_stable(row) else {**row, **dict.fromkeys(self.drawn)} for row in self.rows]
        subject = next(row for row in numbers if row["name"] == self.subject)
        others = [row for row in numbers if row["group"] == self.baselines and row is not subject]
        sentences = verdict(subject, others, COST, {key: MEASURES[key] for key in self.drawn})
        grids = [row for row in numbers if row["method"] == "eulerian" and is_stable(row) and row is not subject]
        if grids and is_stable(subject):
            sentences.append(cheapest_grid(subject, grids, COST, _times_of_errors(subject)))
        return [sentence for sentence in sentences if sentence]

    def finished(self, measure: str) -> list[Row]:
        """Rows of stable variants that have this measure and a time."""
        return [row for row in self.rows if is_stable(row) and None not in (row[measure], row[COST])]

    def stopped(self) -> list[Row]:
        """Rows of variants that became unstable and have a time."""
        return [row for row in self.rows if not is_stable(row) and row[COST] is not None]


def _times_of_errors(row: Row) -> dict[str, str]:
    """The times later than t_eta at which velocity errors are compared, T/2 and the end, in words by measure."""
    end = f"{row['end'] or 0:.2g} T"
    times = {"velocity_error_half": "T/2"} | ({} if end == "0.5 T" else {"velocity_error_end": end})
    return {measure: words for measure, words in times.items() if row[measure] is not None}


def is_stable(row: Row) -> bool:
    """Whether the rollout came to its end."""
    return row["status"] == "complete"


def sections(table: ErrorAgainstTime, turnovers: float) -> list[Section]:
    """The parts of the page: figures with the summary, then tables."""
    first = Section(
        "error-against-time", "Error against run time", " ".join(table.summary),
        notices=[_notice(row) for row in table.rows if not is_stable(row) or row[COST] is None])
    note = ("Wall seconds of a turnover T, with quartiles of the time of a step as bars; errors with their standard "
            "deviation over realisations, if there are several. Line: what nothing else beats in both. Crosses at the "
            "top: became unstable, at the time given. ")
    for measure in table.drawn:
        first.add_figure(measure.replace("_", "-"), f"Run time and {MEASURES[measure]}",
                         scatter(table, [measure]), note + _caption(table, measure))
    overview = Section("overview", "All of these measures")
    if table.drawn:
        overview.add_figure("error-against-run-time", "Error against run time", scatter(table, table.drawn), note)
    errors = {**table.measures, "end": "time of the end (T)", "stopped_at": "unstable at (T)"}
    return [first, overview, _table("errors", "Errors", table.rows, errors,
                                    "Spectrum, energy, counts and KL divergences (nats) are those at the end, "
                                    "Lagrangian statistics those until then, of the stable variants alone; "
                                    f"{turnovers:g} turnovers were asked for."),
            _table("cost", "Cost", table.rows, COSTS, "T is the eddy turnover time when the tracers start.")]


def run_record(name: str, title: str, text: str, machine: Mapping[str, Any]) -> RunRecord:
    """What was compared where: one line for the machine."""
    libraries = ", ".join(f"{library} {version}" for library, version in machine["libraries"].items())
    keys = {"processor": "processor", "cores": "cores", "ranks": "ranks", "threads_per_rank": "threads a rank",
            "device": "device", "date": "date", "eddies": "eddies", "commit": "commit"}
    row = [str(machine[key]) for key in keys]
    return RunRecord(name, title, text, [(*keys.values(), "libraries"), (*row, libraries)])


def _notice(row: Row) -> str:
    when = "" if row["stopped_at"] is None else f" (at {row['stopped_at']:.3g} T)"
    untimed = "; too few steps to time one" if row[COST] is None and not row["status"].startswith("failed") else ""
    return f"{row['name']}{when}: {row['status']}{untimed}"


def _caption(table: ErrorAgainstTime, measure: str) -> str:
    rows = table.finished(measure)
    front = pareto_front([row[COST] for row in rows], [row[measure] for row in rows])
    named = ", ".join(f"{row['name']} ({row[COST]:.3g} s, {row[measure]:.3g})" for row in (rows[i] for i in front))
    return f"On it: {named}." if named else "No variant has a number."


def _table(key: str, title: str, rows: Sequence[Row], columns: Mapping[str, str], text: str) -> Section:
    metrics = [Metric(row["name"], row["name"], {words: _with_spread(row, column) for column, words in columns.items()})
               for row in rows]
    return Section(key, title, text, metrics=metrics)


def _with_spread(row: Row, column: str) -> Any:
    """A number of a row, with its standard deviation over realisations where there are several."""
    spread = row.get(f"{column}_spread")
    return row[column] if spread is None else f"{row[column]:.3g} ± {spread:.2g}"


@styled
def scatter(table: ErrorAgainstTime, measures: Sequence[str]) -> Figure:
    """Error against wall seconds a turnover, a panel for each measure."""
    columns = min(len(measures), 2)
    size = (6.7, 5.0) if columns == 2 else (9.3, 6.0)
    figure, axes = panels(-(-len(measures) // columns), columns, size)
    for axis in axes.flat[len(measures):]:
        axis.remove()
    for axis, measure in zip(axes.flat, measures):
        _draw_panel(axis, table, measure)
    letter(axes.flat[:len(measures)])
    styles = [Line2D([], [], color=colour, marker=marker, linestyle="", label=group)
              for group, (colour, marker) in table.looks.items()]
    if table.stopped():
        styles.append(Line2D([], [], color=DNS, marker="x", linestyle="", label="unstable, at this time"))
    styles.append(Line2D([], [], color=GUIDE, linestyle="--", label="Pareto front"))
    figure.legend(handles=styles, loc="outside lower center", ncols=min(len(styles), 5 if columns == 1 else 8))
    fix_layout(figure)
    for axis, measure in zip(axes.flat, measures):
        _name_points(axis, table, measure)
    return figure


def _draw_panel(axis: Axes, table: ErrorAgainstTime, measure: str) -> None:
    rows, stopped = table.finished(measure), table.stopped()
    axis.set_xscale("log")
    axis.set_yscale("log")
    _set_limits(axis, rows, stopped, measure)
    for row in rows:
        colour, marker = table.looks[row["group"]]
        chosen = row["name"] == table.subject
        bars = [[row[COST] - row["wall_seconds_low"]], [row["wall_seconds_high"] - row[COST]]]
        spread = row.get(f"{measure}_spread") or 0.0
        # On an axis of logarithms no bar reaches 0.
        down = min(spread, 0.9 * row[measure])
        axis.errorbar(row[COST], row[measure], [[down], [spread]], np.maximum(bars, 0), color=colour, marker=marker,
                      elinewidth=1, markersize=9 if chosen else 6, markeredgecolor=DNS if chosen else colour, zorder=4)
    for row in stopped:
        axis.plot(row[COST], _top(axis), color=table.looks[row["group"]][0], marker="x", markersize=7,
                  markeredgewidth=1.8, zorder=4)
    front = pareto_front([row[COST] for row in rows], [row[measure] for row in rows])
    axis.plot([rows[index][COST] for index in front], [rows[index][measure] for index in front], color=GUIDE,
              linestyle="--", linewidth=1.2, zorder=1)
    axis.set(xlabel="wall seconds per turnover T", ylabel=in_symbols(MEASURES[measure]))


def in_symbols(words: str) -> str:
    """Words with their symbols as formulas."""
    return words.replace("t_η", r"$t_\eta$").replace("k_d", "$k_d$")


def _set_limits(axis: Axes, rows: Sequence[Row], stopped: Sequence[Row], measure: str) -> None:
    """Limits with room for names, and ticks that are numbers even where an axis is shorter than a decade."""
    costs, errors = [row[COST] for row in [*rows, *stopped]], [row[measure] for row in rows]
    # Above the highest error there is room for what became unstable.
    for values, limit, room, part in ((costs, axis.set_xlim, (0.16, 0.16), axis.xaxis),
                                      (errors, axis.set_ylim, (0.12, 0.2), axis.yaxis)):
        lowest, highest = (min(values), max(values)) if values else (0.1, 1.0)
        span = max(np.log10(highest / lowest), 0.3)
        limit(lowest * 10 ** (-room[0] * span), highest * 10 ** (room[1] * span))
        part.set_major_locator(LogLocator(subs=(1, 2, 5) if span < 2.5 else (1,)))
        part.set_major_formatter(StrMethodFormatter("{x:g}"))
        part.set_minor_locator(NullLocator())


def _top(axis: Axes) -> float:
    """The height at which what has no error is drawn, below the upper edge."""
    low, high = np.log10(axis.get_ylim())
    return 10 ** (high - 0.03 * (high - low))


def _name_points(axis: Axes, table: ErrorAgainstTime, measure: str) -> None:
    rows, stopped = table.finished(measure), table.stopped()
    places = [(row[COST], row[measure]) for row in rows] + [(row[COST], _top(axis)) for row in stopped]
    if not places:
        return
    names = [row["name"] for row in rows] + [f"{row['name']} {row['stopped_at']:.2g} T" for row in stopped]
    bold = [row["name"] == table.subject for row in [*rows, *stopped]]
    place_labels(axis, axis.transData.transform(places), names, bold)
