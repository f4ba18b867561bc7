"""Sampling: pure functions of seed, number and records, within the space and below its cap."""

import json
import math
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from cconv.errors import ConfigError
from cconv.study.declared.domains import SearchSpace
from cconv.study.records.trials import TrialRecord
from cconv.study.running.sampling import distributions_of, draw, error_weight, random_parameters, suggest_parameters

FULL = 90
SPACE = SearchSpace.model_validate(
    {
        "name": "synthetic",
        "description": "For tests.",
        "parameters": {
            "learning_rate": {"type": "float", "range": [1e-4, 1e-1], "scale": "log", "baseline": 1e-3, "reason": "r"},
            "layers": {"type": "choice", "values": [1, 2, 3], "baseline": 3, "reason": "r"},
            "first_channels": {
                "type": "int", "range": [4, 64], "scale": "log", "baseline": 32, "reason": "r",
                "when": {"layers": [2, 3]},
            },
            "architecture": {
                "type": "choice", "values": ["conv_net", "radial_net"], "baseline": "conv_net", "reason": "r",
            },
            "kernel_size": {
                "type": "int", "range": [3, 7], "baseline": 4, "reason": "r", "when": {"architecture": ["conv_net"]},
            },
        },
    }
)  # fmt: skip


def cost_of(parameters):
    return 100.0 * parameters["layers"] * parameters.get("first_channels", 1)


def error_of(parameters):
    """Best at a learning rate of 1e-2; width and depth help a little."""
    capacity = parameters["layers"] * parameters.get("first_channels", 1)
    return 0.01 * math.exp(2 * abs(math.log10(parameters["learning_rate"]) + 2)) * (1 + 10 / capacity)


def record_of(number, parameters, outcome="completed", reached=FULL):
    errors = [(updates, error_of(parameters) * (1 + 10 / updates)) for updates in (10, 30, FULL) if updates <= reached]
    log = [{"updates": updates, "valid_error": error} for updates, error in errors]
    if outcome == "diverged":
        log[-1]["valid_error"] = None
    return TrialRecord(
        id=f"random_{number:04d}", stage="random", parameters=parameters, config={}, log=log, outcome=outcome, reason=""
    )


def mixed_records(count=40):
    rng = np.random.default_rng(3)
    ends = [("completed", FULL), ("stopped", 10), ("stopped", 30), ("diverged", 30), ("failed", 0), ("interrupted", 10)]
    return [record_of(number, draw(SPACE, rng), *ends[number % len(ends)]) for number in range(count)]


def suggest(records, number, seed=0, affordable=lambda parameters: True, space=SPACE):
    costs = {record.id: cost_of(record.parameters) for record in records}
    return suggest_parameters(
        space,
        records,
        number=number,
        seed=seed,
        full_updates=FULL,
        affordable=affordable,
        costs=costs,
        useless_error=1.0,
    )


def searched(count, number=0):
    """An adaptive search of `count` trials, all to the full budget, with the weights of one proposal."""
    records = []
    for index in range(count):
        parameters = suggest(records, number, seed=index)
        records.append(record_of(index, parameters))
    return records


def test_draws_are_whole_configurations_and_reach_all_of_the_space():
    rng = np.random.default_rng(0)
    drawn = [draw(SPACE, rng) for _ in range(400)]
    assert all(SPACE.holds(parameters) for parameters in drawn)
    sizes = {parameters["kernel_size"] for parameters in drawn if "kernel_size" in parameters}
    assert sizes == {3, 4, 5, 6, 7}
    widths = [parameters["first_channels"] for parameters in drawn if "first_channels" in parameters]
    assert (min(widths), max(widths)) == (4, 64)
    assert np.median(widths) == pytest.approx(16, rel=0.25)  # even on a log scale
    logs = np.log10([parameters["learning_rate"] for parameters in drawn])
    assert np.mean(logs) == pytest.approx(-2.5, abs=0.15)
    assert np.std(logs) == pytest.approx(3 / math.sqrt(12), rel=0.1)


def test_values_are_plain_json():
    rng = np.random.default_rng(0)
    for _ in range(20):
        parameters = draw(SPACE, rng)
        assert json.loads(json.dumps(parameters)) == parameters
        assert all(type(value) in (bool, int, float, str) for value in parameters.values())


def test_a_random_configuration_depends_on_seed_and_index_alone():
    def affordable(parameters):
        return cost_of(parameters) < 5000

    first = [random_parameters(SPACE, 1, index, affordable) for index in range(10)]
    again = [random_parameters(SPACE, 1, index, affordable) for index in reversed(range(10))]
    other = [random_parameters(SPACE, 2, index, affordable) for index in range(10)]
    assert first == again[::-1]
    assert all(one != two for one, two in zip(first, other, strict=True))
    assert all(affordable(parameters) for parameters in first)


def test_a_cap_below_everything_is_refused():
    space = SPACE.model_copy(update={"max_flops_per_particle": 5.0})
    message = "none of 1000 random configurations is below its caps .`max_flops_per_particle` = 5"
    with pytest.raises(ConfigError, match=message):
        random_parameters(space, 0, 0, lambda parameters: False)
    with pytest.raises(ConfigError, match=message):
        suggest(mixed_records(), 0, affordable=lambda parameters: False, space=space)


def test_weights_cover_the_upper_half_evenly_whenever_the_search_ends():
    assert [error_weight(number) for number in range(4)] == [1, 0.75, 0.875, 0.625]
    for count in (8, 32):
        weights = sorted(error_weight(number) for number in range(count))
        np.testing.assert_allclose(np.diff(weights), 0.5 / count)
        assert 0.5 < weights[0] < weights[-1] == 1


def test_proposals_are_whole_affordable_and_repeatable():
    records = mixed_records()

    def affordable(parameters):
        return cost_of(parameters) < 3000

    proposals = [suggest(records, number, affordable=affordable) for number in range(12)]
    assert all(SPACE.holds(parameters) and affordable(parameters) for parameters in proposals)
    assert proposals == [suggest(records, number, affordable=affordable) for number in range(12)]
    assert len({repr(parameters) for parameters in proposals}) == 12
    assert proposals[0] != suggest(records, 0, seed=1, affordable=affordable)


@pytest.mark.integration
def test_a_fresh_process_proposes_the_same_without_torch_or_ray():
    script = """
import json, sys
from test_sampling import mixed_records, suggest
assert not {"torch", "ray"} & {*sys.modules}
print(json.dumps(suggest(mixed_records(), 5)))
"""
    environment = {"PYTHONHASHSEED": "77", "PYTHONPATH": str(Path(__file__).parent)}
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == suggest(mixed_records(), 5)


def test_without_records_a_proposal_is_random():
    rates = [suggest([], number)["learning_rate"] for number in range(40)]
    assert np.mean(np.log10(rates)) == pytest.approx(-2.5, abs=0.5)


def test_records_of_another_space_are_left_out():
    records = mixed_records()
    strange = [
        record_of(100, records[0].parameters | {"learning_rate": 1.0}),
        record_of(101, records[0].parameters | {"window": "none"}),
        record_of(102, {"layers": 1, "learning_rate": 1e-3}),
    ]
    assert suggest([*records, *strange], 2) == suggest(records, 2)


def test_the_search_finds_the_optimum_better_than_chance():
    adaptive = [error_of(record.parameters) for record in searched(40)]
    random = [error_of(random_parameters(SPACE, 9, index, lambda parameters: True)) for index in range(40)]
    assert np.median(adaptive[20:]) < 0.6 * np.median(random)


def test_a_smaller_weight_of_the_error_finds_cheaper_networks():
    for_error, for_both = searched(40, number=0), searched(40, number=15)
    assert error_weight(15) < 0.55
    costs = [np.median([cost_of(record.parameters) for record in run[20:]]) for run in (for_error, for_both)]
    assert costs[1] < 0.5 * costs[0]


def test_what_diverged_is_avoided():
    """Large learning rates diverge after a good start and so come further than what was stopped early."""
    records = []
    rng = np.random.default_rng(5)
    for number in range(60):
        parameters = draw(SPACE, rng)
        large = parameters["learning_rate"] > 5e-3
        records.append(record_of(number, parameters, "diverged" if large else "stopped", FULL if large else 10))
    rates = [suggest(records, number)["learning_rate"] for number in range(20)]
    assert max(rates) < 2e-2  # a quarter of the range is above


def test_distributions_are_of_the_active_parameters_and_hold_them():
    rng = np.random.default_rng(0)
    for _ in range(20):
        parameters = draw(SPACE, rng)
        distributions = distributions_of(SPACE, parameters)
        assert distributions.keys() == parameters.keys()
        for name, distribution in distributions.items():
            assert distribution._contains(distribution.to_internal_repr(parameters[name]))


@pytest.mark.parametrize("path", sorted((Path(__file__).parents[3] / "search_spaces").glob("*.toml")), ids=str)
def test_every_space_of_the_repository_can_be_searched(path):
    from cconv.study.declared.search_space import load_space

    space = load_space(path)
    rng = np.random.default_rng(1)
    records = [record_of(number, {"layers": 4, "learning_rate": 1e-3} | draw(space, rng)) for number in range(12)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for number in range(3):
            assert space.holds(suggest(records, number, space=space))
