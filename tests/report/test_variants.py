"""Names beside points do not cover each other; what is unstable is shown as such."""

import numpy as np
import pytest

from eddies.measures import DRAWN, MEASURES, SHOWN
from eddies.report.variants import ErrorAgainstTime, in_symbols, scatter, section
from eddies.report.figures import panels, styled
from eddies.report.labels import fix_layout, place_labels
from eddies.workflows.variant_rows import BEFORE


def row(name, seconds, error, status="complete", stopped_at=None, kind="particle model"):
    return {"name": name, "label": name, "kind": kind, "on_grid": kind == "coarse grid", "ranks": 1,
            "status": status, "stopped_at": stopped_at, "end": 1.0,
            "wall_seconds": seconds, "wall_seconds_low": seconds and 0.9 * seconds,
            "wall_seconds_high": seconds and 1.2 * seconds, "core_seconds": seconds,
            "seconds_per_step": 0.1, "time_step": 0.02, **dict.fromkeys(BEFORE), **dict.fromkeys(MEASURES, error)}


ROWS = [row("learned", 20.0, 0.1), row("none", 1.0, 0.5), row("slow", 90.0, 0.2),
        row("sph", 50.0, None, "stopped: step 9, rank 0", 0.37),
        row("refused", None, None, "failed: too few slabs")]
TABLE = ErrorAgainstTime(ROWS, "learned")


@styled
def boxes_of_labels(points, labels):
    figure, axes = panels(1, 1, (6.7, 5.0))
    fix_layout(figure)
    axis = axes[0, 0]
    boxes = place_labels(axis, axis.bbox.p0 + points * axis.bbox.size, labels, [False] * len(labels))
    return boxes, axis.bbox


def test_labels_of_a_crowd_cover_neither_each_other_nor_leave_the_panel():
    rng = np.random.default_rng(8)
    points = np.concatenate([0.5 + 0.05 * rng.normal(size=(14, 2)), rng.random((6, 2))])
    boxes, frame = boxes_of_labels(np.clip(points, 0.02, 0.98), [f"variant-{number}" for number in range(20)])
    for number, box in enumerate(boxes):
        assert frame.x0 <= box.x0 and box.x1 <= frame.x1 and frame.y0 <= box.y0 and box.y1 <= frame.y1
        assert not any(box.overlaps(other) for other in boxes[:number])


@pytest.mark.parametrize("across, side", [(0.5, 1), (0.99, -1)])
def test_a_label_alone_stands_beside_its_point_within_the_panel(across, side):
    (box,), frame = boxes_of_labels(np.array([[across, 0.5]]), ["alone"])
    point = frame.p0 + np.array([across, 0.5]) * frame.size
    assert 0 < side * ((box.x0 if side > 0 else box.x1) - point[0]) < 20 and box.y0 < point[1] < box.y1


def texts(axis):
    return {text.get_text() for text in axis.texts}


def test_what_became_unstable_is_named_with_its_time():
    axis = scatter(TABLE, ["velocity_error_early"]).axes[0]
    assert texts(axis) == {"learned", "none", "slow", "sph 0.37 T"}
    crosses = [line for line in axis.lines if line.get_marker() == "x"]
    assert len(crosses) == 1 and crosses[0].get_xdata() == 50.0
    assert crosses[0].get_ydata() > max(r["velocity_kl"] or 0 for r in ROWS)


def test_front_joins_what_nothing_beats():
    axis = scatter(TABLE, ["velocity_error_early"]).axes[0]
    (front,) = [line for line in axis.lines if line.get_linestyle() == "--"]
    assert list(front.get_xdata()) == [1.0, 20.0]


def test_a_measure_that_nobody_has_leaves_an_empty_panel():
    rows = [row("learned", 20.0, None)]
    assert texts(scatter(ErrorAgainstTime(rows, "learned"), DRAWN).axes[0]) == set()


def test_page_tells_what_failed_and_what_the_model_is_worth():
    part = section(TABLE, ["A note."])
    assert part.notices == ["sph (at 0.37 T): stopped: step 9, rank 0", "refused: failed: too few slabs"]
    assert "learned is worth its cost in velocity error at t_η (0.1, 4 of 4 others beaten" in part.text
    assert "A note." in part.text and [figure.name for figure in part.illustrations] == ["error-against-run-time"]
    assert [metric.label for metric in part.metrics] == [r["name"] for r in ROWS]
    assert part.metrics[0].value["wall s per T"] == 20.0
    assert list(part.metrics[0].value)[:len(SHOWN)] == [MEASURES[name] for name in SHOWN]


def test_a_measure_that_no_variant_has_is_no_column():
    rows = [{**each, "qr_kl": None} for each in ROWS]
    assert MEASURES["qr_kl"] not in section(ErrorAgainstTime(rows, "learned")).metrics[0].value


def test_weights_without_their_cost_are_told_apart_from_methods_without_weights():
    rows = [{**ROWS[0], "weights": 7}, {**ROWS[1], "weights": 7, "training_seconds": 2.5}, ROWS[2]]
    shown = [metric.value["training (s)"] for metric in section(ErrorAgainstTime(rows, "learned")).metrics]
    assert shown == ["not stored", 2.5, None]


def test_one_variant_has_a_row_and_no_figure():
    part = section(ErrorAgainstTime(ROWS[:1], "learned"))
    assert part.text.startswith("No other method was run.") and not part.illustrations and len(part.metrics) == 1


def test_rows_without_a_time_say_why():
    untimed = [row("learned", None, 0.1), row("sph", None, None, "stopped: step 1", 0.0)]
    part = section(ErrorAgainstTime(untimed, "learned"))
    assert part.notices == ["learned: complete; too few steps to time one",
                            "sph (at 0 T): stopped: step 1; too few steps to time one"]


def test_an_unstable_model_is_worth_nothing():
    unstable = [{**ROWS[0], "status": "stopped: step 9", "stopped_at": 0.8}, *ROWS[1:]]
    grid = row("grid", 9.0, 0.1, kind="coarse grid")
    summary = ErrorAgainstTime([*unstable, grid], "learned").summary
    assert summary[0] == "learned is worth its cost in no measure." and len(summary) == 2


def test_the_summary_names_the_cheapest_grid_that_would_do():
    """Complete grids alone, at T/2 and at the end; where that is T/2 too it is said once."""
    grids = [row("grid-24", 2.0, 0.2, kind="coarse grid"),
             row("grid-48", 9.0, 0.1, kind="coarse grid"),
             row("unstable", 1.0, 0.05, "stopped: step 9", 0.8, kind="coarse grid")]
    found = ErrorAgainstTime(ROWS + grids, "learned").summary
    assert len(found) == 3 and found[2] == (
        "The cheapest grid that keeps the velocity error after T/2 and 1 T at or below that of learned (0.1, 0.1) is "
        "grid-48 (0.1, 0.1), at 0.45 of its cost.")
    halves = [{**each, "end": 0.501} for each in ROWS + grids[:1]]
    assert ErrorAgainstTime(halves, "learned").summary[2] == (
        "No grid keeps the velocity error after T/2 at or below that of learned (0.1).")
    assert len(TABLE.summary) == 2


@pytest.mark.parametrize("measure", DRAWN)
def test_symbols_are_drawn_as_formulas(measure):
    assert "_" not in in_symbols(MEASURES[measure]).replace(r"$t_\eta$", "").replace("$k_d$", "")


def test_spreads_are_bars_and_stand_in_the_table():
    rows = [{**ROWS[0], "velocity_error_early_spread": 0.04}, ROWS[1]]
    table = ErrorAgainstTime(rows, "learned")
    bars = [bar.get_segments()[0][:, 1] for container in scatter(table, ["velocity_error_early"]).axes[0].containers
            for bar in container.lines[2][1:]]
    assert bars[0].tolist() == pytest.approx([0.06, 0.14]) and bars[1].tolist() == pytest.approx([0.5, 0.5])
    shown = [metric.value["velocity error at t_η"] for metric in section(table).metrics]
    assert shown == ["0.1 ± 0.04", 0.5]
