import pytest

from cconv.study.records import TrialRecord
from cconv.study.selection import choose_finalists, pareto_front, recommend


def record(name, error, outcome="completed", **parameters):
    log = [{"updates": 9, "valid_normalized_mse": error, "seconds": 1.0}]
    return TrialRecord(
        id=name, stage="random", parameters=parameters or {"id": name}, config={}, log=log, outcome=outcome, reason=""
    )


def test_front_holds_what_nothing_beats_in_both():
    points = {"cheap": (3.0, 1.0), "middle": (2.0, 2.0), "beaten": (2.5, 3.0), "best": (1.0, 4.0)}
    assert pareto_front(points) == ["cheap", "middle", "best"]


def test_front_of_equal_points_is_one_of_them():
    assert pareto_front({"a": (1.0, 1.0), "b": (1.0, 1.0)}) == ["a"]
    assert pareto_front({}) == []


def test_finalists_are_accurate_completed_and_on_the_front():
    records = [record("a", 0.1), record("b", 0.2), record("c", 0.3), record("d", 0.01, outcome="stopped")]
    cost = {"a": 5.0, "b": 9.0, "c": 1.0, "d": 1.0}
    assert [chosen.id for chosen in choose_finalists(records, cost, 3)] == ["a", "c"]
    assert [chosen.id for chosen in choose_finalists(records, cost, 1)] == ["a"]


def test_the_same_configuration_is_a_finalist_once():
    records = [record("a", 0.1, kernel_size=4), record("b", 0.1, kernel_size=4)]
    assert [chosen.id for chosen in choose_finalists(records, {"a": 1.0, "b": 1.0}, 2)] == ["a"]


def test_the_cheapest_within_one_standard_error_is_recommended():
    errors = {"best": [0.9, 1.1], "close": [1.05, 1.09], "far": [2.0, 2.0]}
    chosen, reason = recommend(errors, {"best": 10.0, "close": 2.0, "far": 1.0})
    assert chosen == "close"
    assert "cheapest" in reason


def test_the_cheapest_that_is_accurate_enough_is_recommended():
    errors = {"best": [1e-6], "small": [8e-4, 9e-4], "far": [2e-3, 2e-3]}
    cost = {"best": 3.0, "small": 2.0, "far": 1.0}
    assert recommend(errors, cost)[0] == "best"
    chosen, reason = recommend(errors, cost, accurate_enough=1e-3)
    assert chosen == "small"
    assert "accurate enough for this study (limit 0.001" in reason
    assert recommend(errors, cost, accurate_enough=1e-7)[0] == "best"


def test_a_model_that_failed_a_check_of_stability_is_not_recommended_beside_one_that_passed():
    errors, cost = {"best": [0.1, 0.1], "steady": [0.3, 0.3]}, {"best": 1.0, "steady": 2.0}
    chosen, reason = recommend(errors, cost, unstable=["best"])
    assert chosen == "steady"
    assert "passed every check of stability, which 1 others did not" in reason
    chosen, reason = recommend(errors, cost, unstable=["best", "steady"])
    assert chosen == "best"
    assert "No model passed every check" in reason


def test_the_best_is_recommended_where_none_cheaper_is_as_accurate():
    chosen, reason = recommend({"best": [1.0, 1.0], "far": [2.0, 2.0]}, {"best": 10.0, "far": 1.0})
    assert chosen == "best"
    assert "none cheaper" in reason


@pytest.mark.parametrize("cost", [{"a": 1.0, "b": 2.0}, {"a": 1.0, "b": 0.5}])
def test_a_single_best_that_is_cheapest_says_so_truthfully(cost):
    chosen, reason = recommend({"a": [1.0, 1.0], "b": [3.0, 3.0]}, cost)
    assert chosen == "a"
    assert ("cheapest" in reason) == (cost["a"] < cost["b"])
