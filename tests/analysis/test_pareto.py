"""The Pareto front, and the sentences on a model and other methods."""

import numpy as np

from eddies.analysis.pareto import cheapest_grid, pareto_front, verdict


def test_front_of_known_points():
    assert pareto_front([1.0, 2.0, 3.0, 4.0, 2.5], [0.9, 0.5, 0.6, 0.1, np.nan]).tolist() == [0, 1, 3]
    assert pareto_front([4, 1, 2], [0.1, 0.9, 0.5]).tolist() == [1, 2, 0]
    assert pareto_front([1, 1, 2], [0.3, 0.2, 0.2]).tolist() == [1]
    assert pareto_front([1, 1], [0.3, 0.3]).tolist() == [0, 1]
    assert pareto_front([], []).tolist() == []


def row(name, seconds, early, late):
    return {"label": name, "wall_seconds": seconds, "early": early, "late": late}


OTHERS = [row("none", 1, 0.5, 0.9), row("grid", 4, 0.3, 0.1), row("sph", 20, None, None)]
WORDS = {"early": "early error", "late": "late error"}


def verdict_on(model, others=OTHERS):
    return verdict(model, others, WORDS)


def test_a_method_is_worth_its_cost_where_no_cheaper_one_is_as_accurate():
    worth, not_worth = verdict_on(row("learned", 8, 0.1, 0.2))
    assert worth == "learned is worth its cost in early error."
    assert "late error: grid." in not_worth and "early" not in not_worth
    worth, not_worth = verdict_on(row("learned", 2, 0.1, 0.2))  # the grid is more accurate, but slower
    assert "early error; late error" in worth and "error" not in not_worth
    worth, not_worth = verdict_on(row("learned", 2, None, None))
    assert "error" not in worth and "no number for early error; late error" in not_worth
    # The grid has equal cost and errors.
    assert verdict_on(row("learned", 4, 0.3, 0.1))[0].endswith("not worth its cost in any measure.")
    assert len(verdict_on(row("learned", 2, 0.1, 0.2), [])) == 1


def test_errors_within_the_spread_of_realisations_are_equal():
    learned = row("learned", 8, 0.1, 0.2) | {"early_spread": 0.02}
    close, far = (row(name, 4, error, 0.5) for name, error in (("close", 0.115), ("far", 0.125)))
    worth, not_worth = verdict_on(learned, [close, far])
    assert "early error: close." in not_worth and "late error" in worth
    worth, not_worth = verdict_on(learned, [close, far | {"early_spread": 0.03}])
    assert "early error: close and 1 more." in not_worth


def test_the_cheapest_grid_is_as_accurate_at_every_time():
    grids = [row("grid-24", 1, 0.3, 0.4), row("grid-48", 4, 0.1, 0.15), row("grid-40", 3, 0.05, 0.3),
             row("dns", 9, 0, 0), row("unmeasured", None, 0, 0), row("short", 1, 0, None)]
    times, learned = {"early": "T/2", "late": "1 T"}, row("learned", 8, 0.1, 0.2)

    def sentence(model, grids=grids, times=times):
        return cheapest_grid(model, grids, times)

    for model in (learned, learned | {"early_spread": 1.0, "late_spread": 1.0}):
        assert "grid-48; it costs 0.5 times" in sentence(model)
    assert "short; it costs 0.5 times" in sentence(row("learned", 2, 0.1, None), times={"early": "T/2"})
    assert sentence(learned, grids[:1]).startswith("No grid")
    for model in (row("learned", 8, None, 0.2), row("learned", None, 0.1, 0.2)):
        assert sentence(model) == ""
    assert sentence(learned, times={}) == ""
