"""Error against run time of the variants of a scene: what nothing else beats, and all numbers in tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

from eddies.analysis.pareto import cheapest_grid, pareto_front, verdict
from eddies.measures import DRAWN, MEASURES, SHOWN
from eddies.report.figures import DNS, FILTERED, FOURTH, GUIDE, MODEL, SECOND, THIRD, TRUTH, letter, panels, styled
from eddies.report.labels import fix_layout, place_labels
from eddies.report.page import Metric, Section

Row = Mapping[str, Any]

KEY = "variants"
COST = "wall_seconds"
LOOKS = list(zip((MODEL, TRUTH, SECOND, FOURTH, THIRD, DNS, FILTERED), "os^DvPX"))
# Columns of the tables of the page: key in the rows, words. Measures come before them.
COSTS = {"wall_seconds": "wall s per T", "wall_seconds_low": "lower quartile", "wall_seconds_high": "upper quartile",
         "core_seconds": "core s per T", "seconds_per_step": "s per step", "time_step": "time step",
         "ranks": "ranks", "weights": "learned numbers", "training_seconds": "training (s)",
         "training_steps": "training (steps)", "step_seconds": "finding the step (s)"}
OF_TRAINING = ("training_seconds", "training_steps")


@dataclass(frozen=True)
class ErrorAgainstTime:
    """What is drawn: a row of numbers by key for every variant, None where there is none.

    subject: name of the variant that is looked at; every other one is a rival.
    """

    rows: Sequence[Row]
    subject: str

    @property
    def drawn(self) -> list[str]:
        """Those of the measures DRAWN that a row has; of rollouts shorter than T/2 the velocity error at their end."""
        short = not self.finished("velocity_error_half")
        wanted = ["velocity_error_end" if short and name == "velocity_error_half" else name for name in DRAWN]
        return [name for name in wanted if self.finished(name)]

    @property
    def looks(self) -> dict[str, tuple[str, str]]:
        """Colour and marker of every kind of method, in order of appearance."""
        kinds = dict.fromkeys(row["kind"] for row in self.rows)
        return {kind: LOOKS[number % len(LOOKS)] for number, kind in enumerate(kinds)}

    @property
    def summary(self) -> list[str]:
        """Where the subject is worth its cost, where it is not, and which grid, if there are any, would do; what became
        unstable counts as without numbers."""
        numbers = [row if is_stable(row) else {**row, **dict.fromkeys(self.drawn)} for row in self.rows]
        subject = next(row for row in numbers if row["name"] == self.subject)
        others = [row for row in numbers if row is not subject]
        sentences = verdict(subject, others, COST, {key: MEASURES[key] for key in self.drawn})
        grids = [row for row in others if row["on_grid"] and is_stable(row)]
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


def section(table: ErrorAgainstTime, notes: Sequence[str] = ()) -> Section:
    """The part of the page: what the subject is worth, the figure, a table of errors and costs.

    notes: sentences that a reader has to know of the numbers.
    """
    shown = [key for key in SHOWN if any(row[key] is not None for row in table.rows)]
    columns = {**{key: MEASURES[key] for key in shown}, "end": "time of the end (T)", "stopped_at": "unstable at (T)",
               **COSTS}
    metrics = [Metric(row["name"], row["label"], {words: _with_spread(row, key) for key, words in columns.items()})
               for row in table.rows]
    unfinished = [_notice(row) for row in table.rows if not is_stable(row) or row[COST] is None]
    part = Section(KEY, "Error against run time", " ".join([*table.summary, *notes, CAPTION]), notices=unfinished,
                   metrics=metrics)
    if len(table.rows) > 1 and table.drawn:
        part.add_figure("error-against-run-time", "Error against run time", scatter(table, table.drawn), LEGEND)
    return part


LEGEND = ("Wall seconds of a turnover T, with quartiles of the time of a step as bars; errors with their standard "
          "deviation over realisations, if there are several. Line: what nothing else beats in both. Crosses at the "
          "top: became unstable, at the time given.")
CAPTION = ("In the table, spectrum, energy and KL divergences (nats) are those at the end of the rollout, of stable "
           "variants alone; T is the eddy turnover time when the tracers start.")


def _notice(row: Row) -> str:
    when = "" if row["stopped_at"] is None else f" (at {row['stopped_at']:.3g} T)"
    untimed = "; too few steps to time one" if row[COST] is None and not row["status"].startswith("failed") else ""
    return f"{row['label']}{when}: {row['status']}{untimed}"


def _with_spread(row: Row, column: str) -> Any:
    """A number of a row, with its standard deviation over realisations where there are several; of a model whose
    weights came without their cost, that it is not stored."""
    if column in OF_TRAINING and row[column] is None and row["weights"] is not None:
        return "not stored"
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
    styles = [Line2D([], [], color=colour, marker=marker, linestyle="", label=kind)
              for kind, (colour, marker) in table.looks.items()]
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
        colour, marker = table.looks[row["kind"]]
        chosen = row["name"] == table.subject
        bars = [[row[COST] - row["wall_seconds_low"]], [row["wall_seconds_high"] - row[COST]]]
        spread = row.get(f"{measure}_spread") or 0.0
        # On an axis of logarithms no bar reaches 0.
        down = min(spread, 0.9 * row[measure])
        axis.errorbar(row[COST], row[measure], [[down], [spread]], np.maximum(bars, 0), color=colour, marker=marker,
                      elinewidth=1, markersize=9 if chosen else 6, markeredgecolor=DNS if chosen else colour, zorder=4)
    for row in stopped:
        axis.plot(row[COST], _top(axis), color=table.looks[row["kind"]][0], marker="x", markersize=7,
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
    names = [row["label"] for row in rows] + [f"{row['label']} {row['stopped_at']:.2g} T" for row in stopped]
    bold = [row["name"] == table.subject for row in [*rows, *stopped]]
    place_labels(axis, axis.transData.transform(places), names, bold)
