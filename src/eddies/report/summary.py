"""The report section on all variants of a scene: sentences, a table, and the figure of error against run time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from eddies.analysis.pareto import COST, cheapest_grid, pareto_front, verdict
from eddies.measures import DRAWN, MEASURES
from eddies.report.figures import (DNS, GUIDE, OUTLINED, Look, legend_at_foot, letter, panels, plain_log_ticks,
                                   styled)
from eddies.report.page import Section

Row = Mapping[str, Any]

# Columns of the table: key of a number in a row, title.
COLUMNS = {"wall_seconds": "seconds a turnover", "training_seconds": "training (s)",
           "velocity_error_early": "velocity error at t_η", "velocity_error_half": "at T/2",
           "velocity_error_end": "at the end", "spectrum_error": "spectrum error",
           "energy_ratio": "energy, model / truth"}
MOST_NAMED, ROOM = 6, (0.18, 0.06)  # ROOM: width and height of a name, in those of a panel
LETTER, LINE = 0.018, 0.07  # width of a letter and height of a name with its distance from the point, likewise
SIDES = (1, 1), (1, -1), (-1, 1), (-1, -1)  # of a point, where its name may stand: right or left, above or below
CAPTION = ("Wall seconds per turnover T, with the quartiles of the time of a step as bars. Bars of errors are standard "
           "deviations over realisations, if there are several. Dashed line: Pareto front, the variants that no other "
           "one beats in both error and time. Names: the first variant, bold, and the best of the front. Crosses: "
           "variants that became unstable, at the upper edge if they have no such error.")
TEXT = ("Spectrum error and energy are those at the end of the rollout. T is the eddy turnover time at the release of "
        "the tracers. All numbers are in metrics.json.")


@dataclass(frozen=True)
class ErrorAgainstTime:
    """The errors and run times of all variants.

    rows: for each variant, its numbers by key; a missing number is None. subject: name of the variant with which the
    others are compared. looks: colour and marker of each variant.
    """

    rows: Sequence[Row]
    subject: str
    looks: Mapping[str, Look] = field(default_factory=dict)

    @property
    def drawn(self) -> list[str]:
        """Measures of DRAWN that are known for at least one variant that is stable and has a run time.

        If no such variant reaches T/2, the velocity error at the end replaces the one at T/2.
        """
        replaced = {} if self.finished("velocity_error_half") else {"velocity_error_half": "velocity_error_end"}
        return [name for name in (replaced.get(name, name) for name in DRAWN) if self.finished(name)]

    @property
    def summary(self) -> list[str]:
        """Sentences on where the subject is worth its cost, and on the cheapest grid that is at least as accurate.

        A variant that became unstable counts as one without numbers. There are no sentences if the subject has no
        rollout to compare, or if no variant has reached its end.
        """
        numbers = [row if is_stable(row) else {**row, **dict.fromkeys(self.drawn)} for row in self.rows]
        subject = next(row for row in numbers if row["name"] == self.subject)
        if not self.drawn or not is_stable(subject) and subject["stopped_at"] is None:
            return []
        others = [row for row in numbers if row is not subject]
        sentences = verdict(subject, others, {key: MEASURES[key] for key in self.drawn})
        grids = [row for row in others if row["on_grid"] and is_stable(row)]
        if grids and is_stable(subject):
            end = f"{subject['end'] or 0:.2g} T"
            times = {"velocity_error_half": "T/2"} | ({} if end == "0.5 T" else {"velocity_error_end": end})
            known = {measure: words for measure, words in times.items() if subject[measure] is not None}
            sentences.append(cheapest_grid(subject, grids, known))
        return [sentence for sentence in sentences if sentence]

    def finished(self, measure: str) -> list[Row]:
        """Return the rows of stable variants that have this measure and a run time."""
        return [row for row in self.rows if is_stable(row) and None not in (row[measure], row[COST])]

    def stopped(self) -> list[Row]:
        """Return the rows of variants that became unstable and have a run time."""
        return [row for row in self.rows if not is_stable(row) and row[COST] is not None]


def is_stable(row: Row) -> bool:
    """Return whether the rollout of a variant reached its end."""
    return row["status"] == "complete"


def section(table: ErrorAgainstTime, notes: Sequence[str] = ()) -> Section:
    """Return the section with a summary, `notes` on the numbers, the table of errors and costs, and the figure."""
    part = Section("summary", "Summary", " ".join([*table.summary, *notes, TEXT]),
                   columns={title: {row["label"]: _with_spread(row, key) for row in table.rows}
                            for key, title in COLUMNS.items()},
                   notices=[_notice(row) for row in table.rows if not is_stable(row) or row[COST] is None])
    if len(table.rows) > 1 and table.drawn:
        part.add_figure("error-against-run-time", "Error against run time", lambda: scatter(table, table.drawn),
                        CAPTION)
    return part


def _notice(row: Row) -> str:
    when = "" if row["stopped_at"] is None else f" (at {row['stopped_at']:.3g} T)"
    untimed = "; too few steps to time" if row[COST] is None and not row["status"].startswith("failed") else ""
    return f"{row['label']}{when}: {row['status']}{untimed}"


def _with_spread(row: Row, column: str) -> Any:
    """Return the number of a row in a column, with its standard deviation over realisations if this is known.

    If the file of a trained model lacks the cost of its training, return "not stored" for this cost. A time that was
    measured on a busy machine is marked.
    """
    if column == "training_seconds" and row[column] is None:
        return "not stored" if row["weights"] is not None else ""
    if column == COST and row["busy"]:
        return f"{row[column]:.3g} (busy)"
    spread = row.get(f"{column}_spread")
    return row[column] if spread is None else f"{row[column]:.3g} ± {spread:.2g}"


@styled
def scatter(table: ErrorAgainstTime, measures: Sequence[str]) -> Figure:
    """Draw error against wall seconds per turnover, with one panel for each measure."""
    columns = min(len(measures), 2)
    drawn = [row for row in table.rows if any(row in table.finished(measure) for measure in measures)]
    styles = [_entry(table.looks[row["name"]], row["label"]) for row in drawn if not row["on_grid"]]
    if grids := [row["name"] for row in drawn if row["on_grid"]]:
        styles.append(_entry(table.looks[grids[-1]], "coarse grids, the finer the darker"))
    styles += [_entry((table.looks[row["name"]][0], "x"), f"{row['label']}, unstable") for row in table.stopped()]
    styles.append(Line2D([], [], color=GUIDE, linestyle="--", label="Pareto front"))
    figure, axes = panels(-(-len(measures) // columns), columns, (5.4, 4.2) if columns == 2 else (9.3, 6.0))
    for axis in axes.flat[len(measures):]:
        axis.remove()
    for axis, measure in zip(axes.flat, measures):
        _draw_panel(axis, table, measure)
    letter(axes.flat[:len(measures)])
    legend_at_foot(figure, styles)
    return figure


def _entry(look: Look, label: str) -> Line2D:
    return Line2D([], [], color=look[0], marker=look[1], linestyle="", label=label)


def _draw_panel(axis: Axes, table: ErrorAgainstTime, measure: str) -> None:
    rows = table.finished(measure)
    axis.set(xscale="log", yscale="log", xlabel="wall seconds per turnover T", ylabel=in_symbols(MEASURES[measure]),
             autoscale_on=False)
    for row in rows:
        colour, marker = table.looks[row["name"]]
        chosen = row["name"] == table.subject
        bars = [[row[COST] - row["wall_seconds_low"]], [row["wall_seconds_high"] - row[COST]]]
        spread = row.get(f"{measure}_spread") or 0.0
        down = min(spread, 0.9 * row[measure])  # a bar on a logarithmic axis does not reach 0
        axis.errorbar(row[COST], row[measure], [[down], [spread]], np.maximum(bars, 0), color=colour, marker=marker,
                      elinewidth=1, markersize=9 if chosen else 6, markeredgecolor=DNS if chosen else colour, zorder=4)
    for row in table.stopped():  # without an error a little below the upper edge
        place = {"transform": axis.get_xaxis_transform()} if row[measure] is None else {}
        axis.plot(row[COST], row[measure] or 0.97, color=table.looks[row["name"]][0], marker="x", markersize=7,
                  markeredgewidth=1.8, zorder=4, **place)
    front = pareto_front([row[COST] for row in rows], [row[measure] for row in rows])
    axis.plot([rows[index][COST] for index in front], [rows[index][measure] for index in front], color=GUIDE,
              linestyle="--", linewidth=1.2, zorder=1)
    for part, (low, high), limit in ((axis.xaxis, axis.dataLim.intervalx, axis.set_xlim),
                                     (axis.yaxis, axis.dataLim.intervaly, axis.set_ylim)):
        if high >= low:
            room = max(high / low, 2) ** 0.18  # for names
            limit(low / room, high * room)
        plain_log_ticks(part, subs=(1, 2, 5) if high < 300 * low else (1,))
    places = {row["name"]: _place(axis, row, measure) for row in rows}
    taken = [*places.values()]
    for row in _named(table, rows, front, places):
        right, up = _side(row["label"], place := places[row["name"]], np.array(taken))
        letters = LETTER * np.arange(1, len(row["label"]) + 1)
        taken += [place + (right * along, up * LINE / 2) for along in letters]
        axis.annotate(row["label"], (row[COST], row[measure]), (6 * right, 6 * up), textcoords="offset points",
                      ha="left" if right > 0 else "right", va="bottom" if up > 0 else "top", fontsize=8.5,
                      annotation_clip=False, zorder=3, path_effects=OUTLINED,
                      fontweight="bold" if row["name"] == table.subject else "normal")


def _place(axis: Axes, row: Row, measure: str) -> np.ndarray:
    """Return the place (2,) of a point as a share of the panel."""
    return axis.transAxes.inverted().transform(axis.transData.transform((row[COST], row[measure])))


def _side(label: str, place: np.ndarray, points: np.ndarray) -> tuple[int, int]:
    """Return the side of a point, right (1) or left (-1) and above (1) or below (-1), where its name covers the fewest
    of the `points` (n, 2), which are those of the panel and the letters of other names."""
    def covered(side: tuple[int, int]) -> int:
        beside = (points - place) * side
        return int(((beside > 0.005) & (beside < (LETTER * len(label), LINE))).all(1).sum())

    return min(SIDES, key=covered)


def _named(table: ErrorAgainstTime, rows: Sequence[Row], front: Sequence[int],
           places: Mapping[str, np.ndarray]) -> list[Row]:
    """Return at most MOST_NAMED rows whose points get a name: the subject, the most accurate of the front and, if there
    are few points, the others. A point beside a named one gets none. `places` are those of the rows' points."""
    wanted = [row for row in rows if row["name"] == table.subject] + [rows[index] for index in front[::-1]]
    if len(rows) <= MOST_NAMED:
        wanted += rows
    named: list[Row] = []
    for row in wanted:
        others = [places[other["name"]] for other in named]
        if len(named) < MOST_NAMED and all((abs(places[row["name"]] - other) > ROOM).any() for other in others):
            named.append(row)
    return named


def in_symbols(words: str) -> str:
    """Return a text in which the symbols t_η, k_d and M_t are written as formulas."""
    return words.replace("t_η", r"$t_\eta$").replace("k_d", "$k_d$").replace("M_t", "$M_t$")
