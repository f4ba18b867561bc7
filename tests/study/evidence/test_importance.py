"""Importance finds what decides the error in trials where that is known, and nothing where nothing does."""

import json
import math

import numpy as np
import pytest

from cconv.errors import ConfigError, DataError
from cconv.study.declared.domains import Choice, FloatRange, IntRange, SearchSpace
from cconv.study.evidence.effects import detectable_share
from cconv.study.evidence.importance import importance_by_rung
from cconv.study.evidence.partial_dependence import partial_dependence
from cconv.study.evidence.surrogate import axes_of, coordinates, cross_validated_r2, trials_at
from cconv.study.records.found import PartialDependence, RungImportance
from cconv.study.records.trials import TrialRecord

SPACE = SearchSpace(
    name="test",
    description="a test",
    parameters={
        "word": Choice(type="choice", values=["a", "b", "c"], baseline="a", reason="a test"),
        "size": Choice(type="choice", values=[3, 4, 8], baseline=4, reason="a test"),
        "rate": FloatRange(type="float", range=(1e-4, 1e-1), scale="log", baseline=1e-3, reason="a test"),
        "count": IntRange(type="int", range=(1, 6), baseline=2, reason="a test"),
        "only": Choice(type="choice", values=[1], baseline=1, reason="a test"),
    },
)


def drawn(rng):
    return {
        "word": ["a", "b", "c"][rng.integers(3)],
        "size": [3, 4, 8][rng.integers(3)],
        "rate": float(10 ** rng.uniform(-4, -1)),
        "count": int(rng.integers(1, 7)),
        "only": 1,
    }


def record(number, parameters, errors, outcome="completed"):
    log = [{"updates": updates, "valid_error": error} for updates, error in errors.items()]
    return TrialRecord(
        id=f"r{number}", stage="random", parameters=parameters, config={}, log=log, outcome=outcome, reason=""
    )


def trials(count, log10_error, rungs=(10,)):
    rng = np.random.default_rng(1)
    configurations = [drawn(rng) for _ in range(count)]
    return [
        record(number, each, {updates: 10 ** log10_error(each, updates, rng) for updates in rungs})
        for number, each in enumerate(configurations)
    ]


def by_word_and_rate(each, updates, rng):
    """The word makes up two thirds of the variance, the logarithm of the rate a third."""
    return -4 + 1.5 * (each["word"] == "b") + 0.6 * (math.log10(each["rate"]) + 2.5) + 0.05 * rng.normal()


def test_shares_of_variance_are_those_of_an_additive_error():
    entry = importance_by_rung(trials(200, by_word_and_rate), SPACE, [10], useless_error=1.0)[0]
    judged = entry.parameters
    word, rate = 1.5**2 * (1 / 3) * (2 / 3), 0.6**2 * 3**2 / 12
    for name, share in (("word", word / (word + rate)), ("rate", rate / (word + rate))):
        assert judged[name].low < share < judged[name].high
        assert judged[name].share == pytest.approx(share, abs=0.07)
        assert judged[name].f_anova == pytest.approx(share, abs=0.07)
    assert [name for name in judged if judged[name].decided] == ["word", "rate"]
    assert entry.surrogate_r2 > 0.9
    assert set(judged) == {"word", "size", "rate", "count"}
    assert RungImportance(**json.loads(entry.model_dump_json())) == entry


def test_what_the_best_have_in_common_is_important_by_ped_anova():
    records = trials(200, lambda each, updates, rng: -3 - (each["size"] == 8) + 0.1 * rng.normal())
    (entry,) = importance_by_rung(records, SPACE, [10], useless_error=1.0)
    found = {name: each.ped_anova for name, each in entry.parameters.items()}
    assert max(found, key=found.__getitem__) == "size"
    assert entry.best_share == 0.1
    assert sum(found.values()) == pytest.approx(1)


def test_where_nothing_decides_nothing_is_found():
    (entry,) = importance_by_rung(
        trials(60, lambda each, updates, rng: rng.normal() - 5), SPACE, [10], useless_error=1.0
    )
    assert entry.surrogate_r2 < 0.1
    assert not any(each.decided for each in entry.parameters.values())
    assert all(each.low == 0 for each in entry.parameters.values())


def test_the_detectable_share_is_that_of_the_hardest_hyperparameter():
    """A third value or a curve costs a degree of freedom more than a switch, so it must be stronger to be found."""
    (entry,) = importance_by_rung(trials(40, by_word_and_rate), SPACE, [10], useless_error=1.0)
    assert entry.detectable_share == detectable_share(2, 40, 4)


def test_a_hyperparameter_that_the_trials_do_not_vary_is_not_tested():
    records = trials(40, by_word_and_rate)
    records = [record(n, each.parameters | {"size": 4}, {10: each.error_at(10)}) for n, each in enumerate(records)]
    (entry,) = importance_by_rung(records, SPACE, [10], useless_error=1.0)
    size = entry.parameters["size"]
    assert (size.share, size.low, size.high, size.p_value, size.decided) == (
        None,
        None,
        None,
        None,
        False,
    )
    assert entry.detectable_share == detectable_share(2, 40, 3)
    same = [record(n, records[0].parameters, {10: each.error_at(10)}) for n, each in enumerate(records)]
    (entry,) = importance_by_rung(same, SPACE, [10], useless_error=1.0)
    assert (entry.why_none, entry.parameters) == ("no hyperparameter varies among the trials", {})


def test_rungs_are_never_mixed():
    records = trials(
        40, lambda each, updates, rng: -2 - (each["size"] == 8 if updates == 10 else each["word"] == "b"), (10, 30)
    )
    early, late = importance_by_rung(records, SPACE, [10, 30], useless_error=1.0)
    for entry, name in ((early, "size"), (late, "word")):
        judged = entry.parameters[name]
        assert min(judged.share, judged.f_anova, judged.low) > 0.9
    (entry,) = importance_by_rung(records, SPACE, [20], useless_error=1.0)
    assert (entry.why_none, entry.parameters) == ("0 trials were measured, and at least 10 are needed", {})


def test_a_rung_of_survivors_says_so_and_a_rung_of_few_has_no_importance():
    records = trials(40, by_word_and_rate, (10, 30, 90))
    stopped = [record(100 + n, drawn(np.random.default_rng(n)), {10: 0.5}, "stopped") for n in range(20)]
    few = [record(200 + n, each.parameters, {120: 0.5}) for n, each in enumerate(records[:9])]
    entries = importance_by_rung([*records, *stopped, *few], SPACE, [10, 30, 120], useless_error=1.0)
    assert [(entry.updates, entry.trials, entry.censored) for entry in entries] == [
        (10, 60, False),
        (30, 40, True),
        (120, 9, True),
    ]
    assert [bool(entry.parameters) for entry in entries] == [True, True, False]


def useless(count, error=50.0):
    return [record(500 + n, drawn(np.random.default_rng(n)), {10: error}) for n in range(count)]


@pytest.mark.parametrize(("good", "bad", "is_given"), [(10, 10, True), (9, 1, False), (10, 11, False), (1, 23, False)])
def test_where_most_trials_are_no_better_than_the_mean_there_is_no_importance(good, bad, is_given):
    records = [*trials(good, by_word_and_rate), *useless(bad)]
    (entry,) = importance_by_rung(records, SPACE, [10], useless_error=1.0)
    assert entry.clipped == bad
    assert bool(entry.parameters) == is_given
    assert entry.why_none.startswith("" if is_given else f"{bad} of {good + bad} trials are no better than")
    assert (entry.detectable_share is None) == (not is_given)


def test_equal_errors_have_no_importance():
    (entry,) = importance_by_rung(useless(20, error=0.5), SPACE, [10], useless_error=1.0)
    assert (entry.why_none, entry.parameters) == ("all errors are equal", {})


def test_a_trial_that_was_given_up_on_the_way_counts_as_clipped():
    """`give_up_above` is 0.8 here, below what predicting the mean scores: errors count up to it."""
    given_up = [record(300 + n, drawn(np.random.default_rng(n)), {7: 0.9}, "stopped") for n in range(30)]
    (entry,) = importance_by_rung([*trials(20, by_word_and_rate), *given_up], SPACE, [10], useless_error=0.8)
    assert (entry.trials, entry.clipped, entry.censored) == (50, 30, False)
    assert "were given up" in entry.why_none


def test_a_trial_that_ran_out_of_time_on_the_way_makes_the_rung_a_selection():
    slow = record(300, drawn(np.random.default_rng(0)), {7: 0.01}, "stopped")
    (entry,) = importance_by_rung([*trials(20, by_word_and_rate), slow], SPACE, [10], useless_error=1.0)
    assert (entry.trials, entry.censored) == (20, True)


def test_a_diverged_trial_counts_as_useless_at_the_rung_on_whose_way_it_diverged():
    fine, wild = record(0, {}, {10: 0.1, 30: 0.01}), record(1, {}, {10: 50.0, 30: 0.1})
    lost = record(2, {}, {10: 0.2, 17: None}, "diverged")
    given_up = record(3, {}, {7: 99.0}, "stopped")
    records = [fine, wild, lost, given_up]
    assert trials_at(records, 10, useless_error=1.0)[1].tolist() == pytest.approx([-1, 0, math.log10(0.2), 0])
    reached, targets = trials_at(records, 30, after=10, useless_error=1.0)
    assert [each.id for each in reached] == ["r0", "r1", "r2"]
    assert targets.tolist() == pytest.approx([-2, -1, 0])


def test_every_axis_is_even_in_what_the_space_draws():
    axes = axes_of(SPACE)
    rng = np.random.default_rng(0)
    points = coordinates(axes, [drawn(rng) for _ in range(2000)])
    for axis, column in zip(axes, points.T, strict=True):
        low, high = axis.bounds
        assert column.min() >= low
        assert column.max() <= high
        assert np.mean(column) == pytest.approx((low + high) / 2, abs=0.05 * (high - low))
        assert axis.encode(axis.decode(column[0])) == pytest.approx(column[0])


def test_what_is_absent_is_at_its_baseline_and_what_is_outside_is_refused():
    axes = axes_of(SPACE)
    assert coordinates(axes, [{}]).tolist() == [[0, 1, -3, 2]]
    with pytest.raises(DataError, match="`word` = 'd' is not in .*'a', 'b', 'c'.*give the space"):
        coordinates(axes, [{"word": "d"}])
    with pytest.raises(DataError, match="`count` = 7 is not in"):
        coordinates(axes, [{"count": 7}])


def test_a_surrogate_of_noise_does_not_predict():
    rng = np.random.default_rng(0)
    axes = axes_of(SPACE)
    points = coordinates(axes, [drawn(rng) for _ in range(60)])
    assert cross_validated_r2(axes, points, rng.normal(size=60), seed=0) < 0.1
    assert cross_validated_r2(axes, points, points[:, 3], seed=0) > 0.95
    assert cross_validated_r2(axes, points, np.ones(60), seed=0) is None


def test_partial_dependence_follows_an_additive_error():
    records = trials(150, by_word_and_rate)
    found = partial_dependence(records, SPACE, 10, "word", useless_error=1.0)
    assert found.values == ("a", "b", "c")
    rise = np.log10(found.error[1]) - np.log10(found.error[0])
    assert rise == pytest.approx(1.5, abs=0.15)
    assert all(low <= error <= high for low, error, high in zip(found.low, found.error, found.high, strict=True))
    assert len(found.points) == found.trials == 150
    by_rate = partial_dependence(records, SPACE, 10, "rate", useless_error=1.0)
    slope = np.polyfit(np.log10(by_rate.values), np.log10(by_rate.error), 1)[0]
    assert slope == pytest.approx(0.6, abs=0.1)
    assert PartialDependence(**json.loads(by_rate.model_dump_json())) == by_rate


def test_partial_dependence_refuses_what_it_cannot_show():
    records = trials(12, by_word_and_rate)
    with pytest.raises(ConfigError, match="`only` does not vary in the space; those that do: word, size, rate, count"):
        partial_dependence(records, SPACE, 10, "only", useless_error=1.0)
    with pytest.raises(ConfigError, match="0 trials have an error after 11 updates"):
        partial_dependence(records, SPACE, 11, "word", useless_error=1.0)


def test_where_ties_make_all_trials_the_best_none_of_them_differs_from_all():
    """Optuna would warn on the terminal that its quantiles are the same; warnings are errors here."""
    tied = useless(23, error=0.5)
    best = record(23, drawn(np.random.default_rng(23)), {10: 0.1})
    (entry,) = importance_by_rung([*tied, best], SPACE, [10], useless_error=1.0)
    assert all(judged.ped_anova == 0 for judged in entry.parameters.values())
