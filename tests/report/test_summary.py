"""The summary of variants: sentences, table, and the figure of error against run time."""

import pytest

from eddies.measures import DRAWN, MEASURES
from eddies.report.figures import looks, png
from eddies.report.summary import COLUMNS, MOST_NAMED, ErrorAgainstTime, scatter, section
from eddies.workflows.variant_rows import BEFORE


def row(name, seconds, error, status="complete", stopped_at=None, kind="particle model"):
    return {"name": name, "label": name, "kind": kind, "on_grid": kind == "coarse grid", "ranks": 1,
            "status": status, "stopped_at": stopped_at, "end": 1.0,
            "wall_seconds": seconds, "wall_seconds_low": seconds and 0.9 * seconds,
            "wall_seconds_high": seconds and 1.2 * seconds, "core_seconds": seconds,
            "seconds_per_step": 0.1, "time_step": 0.02, "busy": False,
            **dict.fromkeys(BEFORE), **dict.fromkeys(MEASURES, error)}


ROWS = [row("learned", 20.0, 0.1), row("none", 1.0, 0.5), row("slow", 90.0, 0.2),
        row("sph", 50.0, None, "stopped: step 9, rank 0", 0.37),
        row("refused", None, None, "failed: too few slabs")]


def table_of(rows):
    """The table in which the first variant is the subject."""
    names = {each["name"]: [each["name"]] for each in rows}
    cells = {each["name"]: number + 8 for number, each in enumerate(rows) if each["on_grid"]}
    return ErrorAgainstTime(rows, rows[0]["name"], looks(names, cells))


TABLE = table_of(ROWS)


def texts(axis):
    return {text.get_text() for text in axis.texts}


def test_what_became_unstable_is_a_cross_at_the_top():
    axis = scatter(TABLE, ["velocity_error_early"]).axes[0]
    crosses = [line for line in axis.lines if line.get_marker() == "x"]
    assert len(crosses) == 1 and crosses[0].get_xdata() == 50.0
    assert crosses[0].get_ydata() > max(r["velocity_kl"] or 0 for r in ROWS)


def test_what_became_unstable_later_is_a_cross_at_its_error():
    axis = scatter(table_of([*ROWS, row("late", 20.0, 0.4, "stopped: step 9", 0.8)]), ["velocity_error_early"]).axes[0]
    found = [line for line in axis.lines if line.get_marker() == "x"]
    assert [(float(line.get_ydata()[0]), line.get_transform() == axis.transData) for line in found] == [
        (0.97, False), (0.4, True)]


def named(*rows):
    return texts(scatter(table_of([ROWS[0], *rows]), ["velocity_error_early"]).axes[0])


def test_the_subject_and_the_most_accurate_of_the_front_are_named():
    front = [row(f"grid-{number}", 30 * 3.0**number, 0.01 / 9.0**number, kind="coarse grid") for number in range(8)]
    assert named(*front) == {"learned", *(f"grid-{number}" for number in range(9 - MOST_NAMED, 8))}


def test_few_points_are_all_named_and_points_side_by_side_once():
    assert named(row("slow", 90.0, 0.4), row("none", 1.0, 0.5)) == {"learned", "slow", "none"}
    assert named(row("beside", 20.5, 0.101), row("none", 1.0, 0.5)) == {"learned", "none"}


def test_a_name_stands_where_it_covers_no_point():
    """Two points right of the subject, above and below."""
    axis = scatter(table_of([row("model", 1.0, 1.0), row("a", 1.3, 1.2), row("b", 1.3, 0.8), row("c", 9.0, 0.1),
                             row("d", 0.1, 9.0)]), ["velocity_error_early"]).axes[0]
    name = next(text for text in axis.texts if text.get_text() == "model")
    assert name.get_ha() == "right" and {text.get_ha() for text in axis.texts} == {"left", "right"}


@pytest.mark.parametrize("methods", [1, 9])
def test_the_legend_is_within_the_figure_below_the_panels(methods):
    rows = [row(f"method-{number}", 10.0 + number, 0.1) for number in range(methods)]
    figure = scatter(table_of([*rows, ROWS[3]]), DRAWN)
    png(figure)
    (legend,), renderer = figure.legends, figure.canvas.get_renderer()
    box = legend.get_window_extent(renderer)
    assert len(legend.get_texts()) == methods + 2
    assert figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1 and figure.bbox.y0 <= box.y0
    assert box.y1 <= min(axis.xaxis.label.get_window_extent(renderer).y0 for axis in figure.axes)


def test_front_joins_what_nothing_beats():
    axis = scatter(TABLE, ["velocity_error_early"]).axes[0]
    (front,) = [line for line in axis.lines if line.get_linestyle() == "--"]
    assert list(front.get_xdata()) == [1.0, 20.0]


def test_a_measure_that_nobody_has_leaves_an_empty_panel():
    axes = scatter(table_of([row("learned", 20.0, None)]), DRAWN).axes
    assert texts(axes[0]) == set()
    assert not any("_" in axis.get_ylabel().replace(r"$t_\eta$", "").replace("$k_d$", "") for axis in axes)


def test_the_section_has_notices_summary_notes_figure_and_table():
    part = section(TABLE, ["A note."])
    assert part.notices == ["sph (at 0.37 T): stopped: step 9, rank 0", "refused: failed: too few slabs"]
    assert all(text in part.text for text in (*TABLE.summary, "A note."))
    assert [figure.name for figure in part.illustrations] == ["error-against-run-time"]
    assert [label for label, *_ in part.table[1:]] == [r["name"] for r in ROWS]
    assert part.columns["seconds a turnover"]["learned"] == 20.0
    assert part.table[0][1:] == list(COLUMNS.values()) and len(COLUMNS) < 8


def test_weights_without_their_cost_differ_from_methods_without_weights():
    rows = [{**ROWS[0], "weights": 7}, {**ROWS[1], "weights": 7, "training_seconds": 2.5}, ROWS[2]]
    assert [*section(table_of(rows)).columns["training (s)"].values()] == ["not stored", 2.5, ""]


def test_times_of_a_busy_machine_are_marked():
    rows = [{**ROWS[0], "busy": True}, ROWS[1]]
    assert [*section(table_of(rows)).columns["seconds a turnover"].values()] == ["20 (busy)", 1.0]


def test_one_variant_has_a_row_and_no_figure():
    part = section(table_of(ROWS[:1]))
    assert not part.illustrations and len(part.table) == 2


def test_rows_without_a_time_say_why():
    untimed = [row("learned", None, 0.1), row("sph", None, None, "stopped: step 1", 0.0)]
    part = section(table_of(untimed))
    assert all("too few steps" in notice for notice in part.notices) and len(part.notices) == 2


def test_an_unstable_model_is_worth_nothing():
    """And is not compared with a grid."""
    unstable = [{**ROWS[0], "status": "stopped: step 9", "stopped_at": 0.8}, *ROWS[1:]]
    summary = table_of([*unstable, row("grid", 9.0, 0.1, kind="coarse grid")]).summary
    assert len(summary) == 2 and not any("grid" in sentence for sentence in summary)
    assert table_of([unstable[0], ROWS[3]]).summary == [], "nothing reached its end, so nothing is compared"


def test_the_summary_names_the_cheapest_complete_grid_that_is_as_accurate():
    grids = [row("grid-24", 2.0, 0.2, kind="coarse grid"),
             row("grid-48", 9.0, 0.1, kind="coarse grid"),
             row("unstable", 1.0, 0.05, "stopped: step 9", 0.8, kind="coarse grid")]
    *_, sentence = table_of(ROWS + grids).summary
    assert "grid-48" in sentence and "0.45" in sentence and "T/2 and 1 T" in sentence
    # A rollout of T/2 has one time to compare.
    halves = [{**each, "end": 0.501} for each in ROWS + grids[:1]]
    *_, sentence = table_of(halves).summary
    assert sentence.startswith("No grid") and "T/2" in sentence and " T " not in sentence
    assert len(TABLE.summary) == 2


def test_spreads_are_bars_and_in_the_table():
    rows = [{**ROWS[0], "velocity_error_early_spread": 0.04}, ROWS[1]]
    table = table_of(rows)
    bars = [bar.get_segments()[0][:, 1] for container in scatter(table, ["velocity_error_early"]).axes[0].containers
            for bar in container.lines[2][1:]]
    assert bars[0].tolist() == pytest.approx([0.06, 0.14]) and bars[1].tolist() == pytest.approx([0.5, 0.5])
    assert [*section(table).columns["velocity error at t_η"].values()] == ["0.1 ± 0.04", 0.5]
