"""The Pareto front against known answers, and the two sentences on a model and its baselines."""

import numpy as np

from eddies.analysis.pareto import cheapest_grid, pareto_front, verdict


def test_front_of_known_points():
    cost = np.array([1.0, 2.0, 3.0, 4.0, 2.5])
    error = np.array([0.9, 0.5, 0.6, 0.1, np.nan])
    assert pareto_front(cost, error).tolist() == [0, 1, 3]


def test_front_runs_from_cheap_to_accurate_whatever_the_order():
    assert pareto_front([4, 1, 2], [0.1, 0.9, 0.5]).tolist() == [1, 2, 0]


def test_equal_cost_or_error_leaves_the_better_one():
    assert pareto_front([1, 1, 2], [0.3, 0.2, 0.2]).tolist() == [1]


def test_twins_are_both_on_the_front():
    assert pareto_front([1, 1], [0.3, 0.3]).tolist() == [0, 1]
    assert pareto_front([], []).tolist() == []


def test_no_point_of_the_front_is_dominated_and_every_other_one_is():
    cost, error = np.random.default_rng(3).random((2, 60))
    front = pareto_front(cost, error)
    below = (cost[:, None] >= cost[front]) & (error[:, None] >= error[front])
    assert np.all(np.diff(cost[front]) > 0) and np.all(np.diff(error[front]) < 0)
    assert below.sum(axis=1)[front].tolist() == [1] * len(front) and np.all(below.any(axis=1))


def row(name, seconds, early, late):
    return {"label": name, "seconds": seconds, "early": early, "late": late}


BASELINES = [row("none", 1, 0.5, 0.9), row("grid", 4, 0.3, 0.1), row("sph", 20, None, None)]
WORDS = {"early": "early error", "late": "late error"}


def test_verdict_names_where_a_model_is_worth_its_cost_and_where_not():
    worth, not_worth = verdict(row("learned", 8, 0.1, 0.2), BASELINES, "seconds", WORDS)
    assert worth == ("learned is worth its cost in early error (0.1, 3 of 3 others beaten; the best of them: grid, "
                     "0.3 in 0.5 of its time): nothing that is as fast is as accurate.")
    assert not_worth == ("It is not in late error (0.2, 2 of 3 others beaten; as accurate and no slower: grid, 0.1 "
                         "in 0.5 of its time).")


def test_a_more_accurate_baseline_that_is_slower_leaves_a_model_its_worth():
    worth, not_worth = verdict(row("learned", 2, 0.1, 0.2), BASELINES, "seconds", WORDS)
    assert "late error (0.2, 2 of 3 others beaten; the best of them: grid, 0.1 in 2 of its time)" in worth
    assert not_worth == "There is no measure in which another method is as accurate and no slower."


def test_a_model_without_numbers_is_worth_its_cost_in_nothing():
    worth, not_worth = verdict(row("learned", 2, None, None), BASELINES, "seconds", WORDS)
    assert worth == "learned is worth its cost in no measure."
    assert not_worth == "It is not in early error (no number), late error (no number)."


def test_what_differs_by_less_than_the_spread_of_realisations_is_as_accurate():
    learned = row("learned", 8, 0.1, 0.2) | {"early_spread": 0.02}
    close, far = (row(name, 4, error, 0.5) for name, error in (("close", 0.115), ("far", 0.125)))
    worth, not_worth = verdict(learned, [close, far], "seconds", WORDS)
    assert "early error (0.1, 1 of 2 others beaten; as accurate and no slower: close, 0.115" in not_worth
    worth, not_worth = verdict(learned, [close, far | {"early_spread": 0.03}], "seconds", WORDS)
    assert "0 of 2 others beaten" in not_worth and "late error" in worth


GRIDS = [row("grid-24", 1, 0.3, 0.4), row("grid-48", 4, 0.1, 0.15), row("grid-40", 3, 0.05, 0.3), row("dns", 9, 0, 0),
         row("unmeasured", None, 0, 0), row("short", 1, 0, None)]
TIMES = {"early": "T/2", "late": "1 T"}


def test_the_cheapest_grid_is_as_accurate_at_every_time():
    assert cheapest_grid(row("learned", 8, 0.1, 0.2), GRIDS, "seconds", TIMES) == (
        "The cheapest grid that keeps the velocity error after T/2 and 1 T at or below that of learned (0.1, 0.2) is "
        "grid-48 (0.1, 0.15), at 0.5 of its cost.")
    early = cheapest_grid(row("learned", 2, 0.1, None), GRIDS, "seconds", {"early": "T/2"})
    assert early == ("The cheapest grid that keeps the velocity error after T/2 at or below that of learned (0.1) is "
                     "short (0), at 0.5 of its cost.")


def test_means_are_compared_whatever_their_spread():
    learned = row("learned", 8, 0.1, 0.2) | {"early_spread": 1.0, "late_spread": 1.0}
    assert "is grid-48 (" in cheapest_grid(learned, GRIDS, "seconds", TIMES)


def test_that_no_grid_is_as_accurate_is_said_and_of_a_model_without_numbers_nothing():
    assert cheapest_grid(row("learned", 8, 0.1, 0.2), GRIDS[:1], "seconds", TIMES) == (
        "No grid keeps the velocity error after T/2 and 1 T at or below that of learned (0.1, 0.2).")
    for model in (row("learned", 8, None, 0.2), row("learned", None, 0.1, 0.2)):
        assert cheapest_grid(model, GRIDS, "seconds", TIMES) == ""
    assert cheapest_grid(row("learned", 8, 0.1, 0.2), GRIDS, "seconds", {}) == ""
