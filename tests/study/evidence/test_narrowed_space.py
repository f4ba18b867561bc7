"""Refinement: on synthetic records whose optimum is known, only what the evidence speaks against goes."""

import math

import numpy as np
import pytest

from cconv.study.declared.domains import SearchSpace
from cconv.study.declared.search_space import load_space
from cconv.study.evidence.narrowed_space import refine, write_space
from cconv.study.records.trials import TrialRecord
from cconv.study.running.sampling import draw

FULL = 90
SPACE = SearchSpace.model_validate(
    {
        "name": "synthetic",
        "description": "For tests.",
        "max_flops_per_particle": 2e6,
        "parameters": {
            "training.learning_rate": {
                "type": "float", "range": [1e-4, 1e-1], "scale": "log", "baseline": 3e-3, "reason": "r.",
            },
            "network.relative_cutoff": {"type": "float", "range": [1.0, 3.0], "baseline": 2.0, "reason": "r."},
            "network.message": {
                "type": "choice", "values": ["absolute", "difference"], "baseline": "difference", "reason": "r."
            },
            "network.architecture": {
                "type": "choice", "values": ["conv_net", "radial_net"], "baseline": "conv_net", "reason": "r."
            },
            "network.kernel_size": {
                "type": "int", "range": [2, 12], "baseline": 7, "reason": "r.",
                "when": {"network.architecture": ["conv_net"]},
            },
            "network.mapping": {
                "type": "choice", "values": ["identity", "ball_to_cube_radial"], "baseline": "identity", "reason": "r.",
                "when": {"network.message": ["absolute"]},
            },
        },
    }
)  # fmt: skip


def error_of(parameters, message=10.0):
    """Best at a learning rate of 3e-3, kernel size 7 and differences; the cutoff and the architecture do not matter.

    `message` says how strongly the message acts on the logarithm.
    """
    log = 4 * abs(math.log10(parameters["training.learning_rate"]) + 2.5) - 7
    log += message * (parameters["network.message"] == "absolute")
    return math.exp(log + 2 * abs(parameters.get("network.kernel_size", 9.7) - 7))


def record_of(number, parameters, error, reached=FULL, outcome=None):
    log = [
        {"updates": updates, "valid_error": error * (1 + 10 / updates)}
        for updates in (10, 30, FULL)
        if updates <= reached
    ]
    ends = outcome or ("completed" if reached == FULL else "stopped")
    return TrialRecord(
        id=f"random_{number:04d}", stage="random", parameters=parameters, config={}, log=log, outcome=ends, reason=""
    )


def records_of(count, outcome=None, **strengths):
    rng = np.random.default_rng(0)
    drawn = [draw(SPACE, rng) for _ in range(count)]
    return [record_of(number, each, error_of(each, **strengths), outcome=outcome) for number, each in enumerate(drawn)]


def asha_records(count, **strengths):
    """A third of the trials goes on after 10 updates, and a third of these after 30."""
    by_error = sorted(records_of(count, **strengths), key=lambda record: record.last["valid_error"])
    reached = [FULL if rank < count / 9 else 30 if rank < count / 3 else 10 for rank in range(count)]
    return [
        record_of(number, record.parameters, error_of(record.parameters, **strengths), updates)
        for number, (record, updates) in enumerate(zip(by_error, reached, strict=True))
    ]


def unchanged(refined):
    """Names of the parameters whose domain is as it was."""
    kept = refined.parameters.items()
    return {name for name, new in kept if new.model_copy(update={"reason": "r."}) == SPACE.parameters[name]}


@pytest.mark.parametrize("records_of", [records_of, asha_records])
def test_ranges_close_in_on_the_known_optimum_and_what_has_no_influence_stays(records_of):
    refined, reasons = refine(SPACE, records_of(240, message=0), FULL)
    low, high = refined.parameters["training.learning_rate"].range
    assert 1e-4 < low < 3e-3 < high < 1e-1
    low, high = refined.parameters["network.kernel_size"].range
    assert 2 < low <= 7 <= high < 12
    assert unchanged(refined) == {
        "network.relative_cutoff",
        "network.message",
        "network.architecture",
        "network.mapping",
    }
    assert all("narrowed to" in reasons[name] for name in ("training.learning_rate", "network.kernel_size"))
    assert all("kept: no clear preference" in reasons[name] for name in unchanged(refined))


@pytest.mark.parametrize("records_of", [records_of, asha_records])
def test_a_value_that_the_best_do_not_use_goes(records_of):
    refined, reasons = refine(SPACE, records_of(240), FULL)
    assert refined.parameters["network.message"].values == ["difference"]
    assert "hardly use 'absolute' (0 of the best, 1" in reasons["network.message"]
    assert {"network.relative_cutoff", "network.architecture"} <= unchanged(refined)


def test_trials_are_compared_at_the_largest_budget_that_enough_reached():
    _, reasons = refine(SPACE, asha_records(240), FULL)
    assert "the best 60 of 240 trials (80 compared at 30 of 90 updates)" in reasons["training.learning_rate"]


def test_conditions_follow_what_is_left():
    refined, reasons = refine(SPACE, records_of(240), FULL)
    assert "network.mapping" not in refined.parameters
    assert reasons["network.mapping"] == "left out: no remaining value of network.message makes it active"
    assert refined.parameters["network.kernel_size"].when == {"network.architecture": ["conv_net"]}


def test_the_refined_space_holds_the_best_trial_and_the_baseline():
    records = records_of(120)
    refined, _ = refine(SPACE, records, FULL)
    best = min(records, key=lambda record: error_of(record.parameters))
    assert refined.holds(best.parameters)
    assert refined.baseline == SPACE.baseline
    assert refined.max_flops_per_particle == SPACE.max_flops_per_particle


def test_the_baseline_stays_even_where_the_evidence_is_against_it():
    parameters = dict(SPACE.parameters)
    parameters["network.message"] = parameters["network.message"].model_copy(update={"baseline": "absolute"})
    parameters["training.learning_rate"] = parameters["training.learning_rate"].model_copy(update={"baseline": 1e-4})
    space = SPACE.model_copy(update={"parameters": parameters})
    refined, reasons = refine(space, records_of(240), FULL)
    assert refined.parameters["network.message"].values == ["absolute", "difference"]
    assert "kept, as the baseline" in reasons["network.message"]
    assert refined.parameters["training.learning_rate"].range[0] == 1e-4
    assert refined.parameters["training.learning_rate"].range[1] < 1e-1
    assert "the baseline" in reasons["training.learning_rate"]


def test_thin_evidence_narrows_nothing():
    few = records_of(19)
    for records in ([], few, [*few, *few], [record_of(0, SPACE.baseline, 0.1)] * 50):
        refined, reasons = refine(SPACE, records, FULL)
        assert refined.parameters.keys() == SPACE.parameters.keys()
        assert all("kept: too few trials" in reason for reason in reasons.values())


def test_failed_and_interrupted_trials_say_nothing():
    for outcome in ("failed", "interrupted"):
        _, reasons = refine(SPACE, records_of(60, outcome=outcome), FULL)
        assert all("too few trials, 0 of the" in reason for reason in reasons.values())


def test_chance_alone_hardly_ever_narrows():
    """Errors without any influence: each end or value goes with a chance of at most 1 %."""
    changed = 0
    for seed in range(60):
        rng = np.random.default_rng(1000 + seed)
        records = [record_of(number, draw(SPACE, rng), rng.uniform()) for number in range(60)]
        refined, _ = refine(SPACE, records, FULL)
        changed += sum(
            refined.parameters[name].range != SPACE.parameters[name].range
            for name in ("training.learning_rate", "network.relative_cutoff")
        )
    assert changed <= 8  # 240 ends were judged; at 1 % each, more than 8 have a chance below 1e-3


def test_a_refined_space_is_read_back_as_it_was_written(tmp_path):
    refined, reasons = refine(SPACE, records_of(240), FULL)
    path = tmp_path / "stages" / "refined.toml"
    write_space(refined, path)
    assert load_space(path) == refined
    for name, parameter in refined.parameters.items():
        assert parameter.reason.endswith(f"{reasons[name][1:]}.")


@pytest.mark.parametrize("name", ["density", "smoke", "thesis_initial", "thesis_random", "thesis_bayesian"])
def test_every_space_of_the_repository_is_read_back_as_it_was_written(name, tmp_path):
    space = load_space(f"search_spaces/{name}.toml")
    write_space(space, tmp_path / "copy.toml")
    assert load_space(tmp_path / "copy.toml") == space
