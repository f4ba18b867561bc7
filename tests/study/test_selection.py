import dataclasses
import json

import numpy as np
import pytest

from cconv.errors import DataError
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


@pytest.fixture
def noise():
    """Noise that all models share by seed and unit."""
    return np.exp(np.random.default_rng(0).normal(0, 0.5, (5, 8)))


def test_the_cheapest_within_one_standard_error_is_recommended(noise):
    wobble = np.array([0.9, 1.13, 0.95, 1.1, 0.93])[:, None]
    close = noise * wobble
    errors = {"best": noise, "close": close * (1.01 * noise.mean() / close.mean()), "far": 2 * noise}
    chosen = recommend(errors, {"best": 10.0, "close": 2.0, "far": 1.0}, {})
    assert (chosen.id, chosen.best) == ("close", "best")
    assert "cheapest model" in chosen.reason
    assert "within one standard error of the best" in chosen.reason
    assert "5 times the cost" in chosen.reason


def test_a_seed_that_failed_does_not_make_a_model_as_accurate(noise):
    failed = noise * np.array([1.0, 1.0, 1.0, 1.0, 500.0])[:, None]
    chosen = recommend({"best": noise, "failed": failed}, {"best": 2.0, "failed": 1.0}, {})
    assert chosen.comparisons[0].to_best.difference < chosen.comparisons[0].to_best.standard_error * 1.01
    assert chosen.id == "best"


def test_what_all_models_share_does_not_blur_the_comparison(noise):
    chosen = recommend({"best": noise, "worse": 1.2 * noise}, {"best": 2.0, "worse": 1.0}, {})
    assert np.std(noise) > 0.4  # far more than the difference
    assert chosen.id == "best"


def test_a_sure_but_small_loss_is_not_inferior(noise):
    errors, cost = {"best": noise, "close": 1.03 * noise}, {"best": 2.0, "close": 1.0}
    chosen = recommend(errors, cost, {})
    assert chosen.by_rule == {"one_standard_error": "best", "non_inferiority": "close", "accurate_enough": None}
    assert chosen.id == "close"
    assert "that is not inferior to the best" in chosen.reason
    assert "the first alone would choose best, the second close" in chosen.reason
    assert recommend(errors, cost, {}, margin=0.01).id == "best"


def test_the_cheapest_that_is_accurate_enough_is_recommended():
    errors = {"best": np.full((1, 3), 1e-6), "small": np.full((2, 3), 8e-4), "far": np.full((2, 3), 2e-3)}
    cost = {"best": 3.0, "small": 2.0, "far": 1.0}
    assert recommend(errors, cost, {}).id == "best"
    chosen = recommend(errors, cost, {}, accurate_enough=1e-3)
    assert chosen.id == chosen.by_rule["accurate_enough"] == "small"
    assert "accurate enough for this study (limit 0.001)" in chosen.reason
    assert "both choose best" in chosen.reason
    assert recommend(errors, cost, {}, accurate_enough=1e-7).id == "best"


def test_a_model_that_failed_a_check_of_stability_is_set_aside_beside_one_that_passed(noise):
    errors, cost = {"best": 0.1 * noise, "steady": 0.3 * noise}, {"best": 1.0, "steady": 2.0}
    chosen = recommend(errors, cost, {"best": ["isolated particles"]})
    assert (chosen.id, chosen.best) == ("steady", "steady")
    assert "1 of 2 models did not and were set aside: best (isolated particles)" in chosen.reason
    assert [each.why_not for each in chosen.comparisons] == ["failed isolated particles", ""]
    chosen = recommend(errors, cost, {"best": ["isolated particles"], "steady": ["float32"]})
    assert chosen.id == "best"
    assert "No model passed every check" in chosen.reason


def test_a_cheaper_model_that_is_unstable_is_not_called_costlier(noise):
    chosen = recommend({"best": noise, "wild": 2 * noise}, {"best": 2.0, "wild": 1.0}, {"wild": ["float32"]})
    assert chosen.id == "best"
    assert "no cheaper one is stable" in chosen.reason


def test_accurate_enough_does_not_excuse_instability(noise):
    errors, cost = {"steady": noise, "wild": 1e-9 * noise}, {"steady": 2.0, "wild": 1.0}
    assert recommend(errors, cost, {"wild": ["float32"]}, accurate_enough=1e-3).id == "steady"


def test_the_best_is_recommended_where_none_cheaper_is_as_accurate(noise):
    chosen = recommend({"best": noise, "far": 2 * noise}, {"best": 10.0, "far": 1.0}, {})
    assert chosen.id == "best"
    assert "no cheaper one is as accurate" in chosen.reason


@pytest.mark.parametrize("cost", [{"a": 1.0, "b": 2.0}, {"a": 1.0, "b": 0.5}])
def test_a_single_best_that_is_cheapest_says_so_truthfully(noise, cost):
    chosen = recommend({"a": noise, "b": 3 * noise}, cost, {})
    assert chosen.id == "a"
    assert ("cheapest" in chosen.reason) == (cost["a"] < cost["b"])


def test_the_recommended_model_is_eligible_and_none_eligible_is_cheaper():
    rng = np.random.default_rng(1)
    for _ in range(30):
        names = list("abcdef")
        errors = {name: np.exp(rng.normal(0, 0.3) + rng.normal(0, 0.3, (rng.choice([1, 5]), 4))) for name in names}
        cost = dict(zip(names, rng.uniform(1, 10, 6), strict=True))
        failures = {name: ["check"] for name in names if rng.random() < 0.4}
        chosen = recommend(errors, cost, failures, accurate_enough=0.5)
        eligible = [each.id for each in chosen.comparisons if each.eligible]
        assert chosen.id == min(eligible, key=cost.__getitem__)
        assert chosen.best in eligible
        assert len(failures) == 6 or not failures.get(chosen.id)
        json.dumps(dataclasses.asdict(chosen), allow_nan=False)


def test_the_best_is_as_good_as_itself(noise):
    (alone,) = recommend({"a": noise}, {"a": 1.0}, {}).comparisons
    assert alone.within_one_se
    assert alone.non_inferior
    assert (alone.to_best.difference, alone.to_best.ratio) == (0.0, 1.0)


def test_models_without_cost_are_refused(noise):
    with pytest.raises(DataError, match="'b'"):
        recommend({"a": noise, "b": noise}, {"a": 1.0}, {})
    with pytest.raises(DataError, match="every model"):
        recommend({}, {}, {})
