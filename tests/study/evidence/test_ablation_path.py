"""The path from the baseline to the best: every step valid, one change each, the one that helps most first."""

import math

import numpy as np
import pytest

from cconv.errors import ConfigError
from cconv.study.declared.domains import Choice, FloatRange, SearchSpace
from cconv.study.evidence.ablation_path import ablation_order, path_configurations
from cconv.study.records.trials import TrialRecord

WORDS = {"type": "choice", "reason": "a test"}
SPACE = SearchSpace(
    name="test",
    description="a test",
    parameters={
        "architecture": Choice(values=["conv_net", "radial_net"], baseline="conv_net", **WORDS),
        "kernel_size": Choice(values=[3, 4, 5], baseline=4, when={"architecture": ["conv_net"]}, **WORDS),
        "terms": Choice(values=[4, 8], baseline=4, when={"architecture": ["radial_net"]}, **WORDS),
        "width": Choice(values=[8, 16], baseline=16, **WORDS),
        "rate": FloatRange(type="float", range=(1e-4, 1e-1), scale="log", baseline=1e-3, reason="a test"),
    },
)
BASELINE = {"architecture": "conv_net", "kernel_size": 4, "width": 16, "rate": 1e-3}
BEST = {"architecture": "radial_net", "terms": 8, "width": 8, "rate": 1e-2}


def record(number, parameters, error):
    log = [{"updates": 9, "valid_error": error}]
    return TrialRecord(
        id=f"r{number}", stage="random", parameters=parameters, config={}, log=log, outcome="completed", reason=""
    )


def error_of(each):
    from_best_rate = abs(math.log10(each["rate"]) + 2)
    return 10 ** (-2 - (each["architecture"] == "radial_net") + 0.3 * from_best_rate - 0.05 * (each["width"] == 8))


@pytest.fixture(scope="module")
def records():
    """Trials whose error falls most with the architecture, less with the rate, hardly with the width."""
    rng = np.random.default_rng(0)
    drawn = []
    for _ in range(80):
        values = {
            name: each.values[rng.integers(len(each.values))]
            for name, each in SPACE.parameters.items()
            if name != "rate"
        }
        drawn.append(SPACE.active(values | {"rate": float(10 ** rng.uniform(-4, -1))}))
    return [record(number, each, error_of(each)) for number, each in enumerate(drawn)]


def test_what_helps_most_comes_first(records):
    assert ablation_order(records, SPACE, BASELINE, BEST, 9, useless_error=1.0) == ["architecture", "rate", "width"]
    assert ablation_order(records, SPACE, BASELINE, BEST, 9, seed=5, useless_error=1.0) == [
        "architecture",
        "rate",
        "width",
    ]


@pytest.mark.parametrize(
    "order", [["architecture", "rate", "width"], ["width", "architecture", "rate"], ["rate", "width", "architecture"]]
)
def test_a_path_leads_from_the_baseline_to_the_best_by_valid_configurations(order):
    path = path_configurations(BASELINE, BEST, order, SPACE)
    assert path[0] == BASELINE
    assert path[-1] == BEST
    assert all(SPACE.active(each) == each for each in path)
    for change, before, after in zip(order, path, path[1:], strict=False):
        assert {name for name in before if name in after and before[name] != after[name]} == {change}
    turned = order.index("architecture") + 1
    assert all("kernel_size" in each and "terms" not in each for each in path[:turned])
    assert all("kernel_size" not in each and "terms" in each for each in path[turned:])


def test_what_neither_end_has_is_at_the_baseline_of_the_space_where_it_is_active_between():
    words = WORDS | {"baseline": 0, "values": [0, 1]}
    parameters = {"a": Choice(**words), "b": Choice(**words), "c": Choice(when={"a": [1], "b": [0]}, **words)}
    space = SearchSpace(name="test", description="a test", parameters=parameters)
    path = path_configurations({"a": 0, "b": 0}, {"a": 1, "b": 1}, ["a", "b"], space)
    assert path == [{"a": 0, "b": 0}, {"a": 1, "b": 0, "c": 0}, {"a": 1, "b": 1}]


def test_the_same_configuration_needs_no_change(records):
    assert ablation_order(records, SPACE, BASELINE, BASELINE, 9, useless_error=1.0) == []
    assert path_configurations(BASELINE, BASELINE, [], SPACE) == [BASELINE]


def test_too_few_trials_are_refused(records):
    with pytest.raises(ConfigError, match="9 trials have an error after 9 updates; a surrogate needs 10"):
        ablation_order(records[:9], SPACE, BASELINE, BEST, 9, useless_error=1.0)
