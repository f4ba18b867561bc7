"""Stages that read what is not there are refused, with the nearest name; what reads what follows from their order."""

import pytest

from cconv.errors import ConfigError
from cconv.study.declared.stage import readers_of, reads_of
from cconv.study.studies import Study
from cconv.validation import validated

SEARCH = {"space": "space.toml"}


def study(**stages):
    return validated(Study, {"name": "s", "task": "density_rate", "search": SEARCH, "stages": stages}, "s.toml")


def test_a_stage_has_the_kind_of_its_name_unless_it_says_otherwise():
    stages = study(random={}, second={"kind": "random", "trials": 3}).stages
    assert [stage.kind for stage in stages.values()] == ["random", "random"]
    assert list(stages) == ["random", "second"]


def test_a_stage_reads_all_earlier_ones_that_it_can_use_or_those_it_names():
    stages = study(
        closed_form={}, random={}, second={"kind": "random"}, refine={}, adaptive={"reads": ["second"]}, finalists={}
    ).stages
    assert reads_of(stages, "refine") == ["random", "second"]
    assert reads_of(stages, "adaptive") == ["second"]
    assert reads_of(stages, "finalists") == ["closed_form", "random", "second", "adaptive"]


def test_more_trials_reach_every_stage_that_reads_them_directly_or_not():
    stages = study(closed_form={}, random={}, refine={}, adaptive={"space": "refine"}, finalists={}, select={}).stages
    assert readers_of(stages, "random") == {"refine", "adaptive", "finalists", "select"}
    assert readers_of(stages, "adaptive") == {"finalists", "select"}


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        ({"random": {}, "finalists": {"reads": ["randm"]}}, "`finalists` names `randm`.*Did you mean 'random'"),
        ({"finalists": {"reads": ["random"]}, "random": {}}, "no stage before it"),
        ({"random": {}, "adaptive": {"space": "refine"}}, "`adaptive` names `refine`"),
        ({"random": {}, "adaptive": {"space": "random"}}, "no stage of kind refine"),
        ({"random": {}, "select": {}}, "`select` has nothing to read; put one of finalists"),
        ({"closed_form": {}, "refine": {"reads": ["closed_form"]}}, "cannot use the records of `closed_form`"),
        ({"random": {"trails": 3}}, "unknown key `stages.random.*trails`"),
        ({"rondom": {}}, "stages.rondom"),
        ({}, "stages"),
    ],
)
def test_what_does_not_fit_is_named(stages, message):
    with pytest.raises(ConfigError, match=message):
        study(**stages)


def test_finalists_need_no_search_before_them():
    named = study(finalists={"include": {"named": {"network.layers": 1}}}, select={}).stages
    assert reads_of(named, "finalists") == []
    assert reads_of(named, "select") == ["finalists"]


@pytest.mark.parametrize(
    ("stages", "counting"),
    [
        ({"random": {}}, "random"),
        ({"initialization": {}}, "initialization"),
        ({"finalists": {}, "converge": {"budgets": [10]}}, "converge"),
    ],
)
def test_a_budget_of_time_is_for_stages_that_do_not_count_updates(stages, counting):
    timed = {"name": "s", "task": "density_rate", "search": SEARCH, "training": {"cpu_seconds": 60.0}}
    with pytest.raises(ConfigError, match=f"stage `{counting}` compares trainings after equal numbers of updates"):
        validated(Study, timed | {"stages": stages}, "s.toml").check_stages()
    others = {"baseline": {}, "closed_form": {}, "finalists": {}, "select": {}}
    validated(Study, timed | {"stages": others}, "s.toml").check_stages()


def test_closed_forms_need_a_loss_that_least_squares_minimises():
    weighted = {"name": "s", "task": "density_rate", "search": SEARCH, "training": {"loss": "neighbor_weighted"}}
    with pytest.raises(ConfigError, match=r"training\.loss. must be 'mse' or 'balanced_mse' for stage `closed_form`"):
        validated(Study, weighted | {"stages": {"closed_form": {}, "finalists": {}}}, "s.toml").check_stages()


def test_a_stage_that_converges_names_finalists_that_are_sure_to_be_there():
    stages = {"random": {}, "finalists": {"include": {"named": {"network.layers": 1}}}}
    named = study(**stages, converge={"budgets": [10, 20], "of": ["baseline", "named"]}, select={}).stages
    assert reads_of(named, "select") == ["finalists", "converge"]
    with pytest.raises(ConfigError, match="names the finalist `random_0001`; it can name baseline, named"):
        study(**stages, converge={"budgets": [10], "of": ["random_0001"]})


@pytest.mark.parametrize("budgets", [[20, 10], [10, 10], [], [0, 5]])
def test_budgets_ascend(budgets):
    with pytest.raises(ConfigError, match="budgets"):
        study(random={}, finalists={}, converge={"budgets": budgets})


@pytest.mark.parametrize("kind", ["initialization", "reference", "importance", "refine", "ablation", "select"])
def test_a_second_stage_whose_result_would_replace_the_firsts_is_refused(kind):
    before = {"random": {}, "finalists": {}}
    with pytest.raises(
        ConfigError, match=f"stages `{kind}` and `again` are both of kind {kind}, .*; remove one"
    ) as told:
        study(**before, **{kind: {}, "again": {"kind": kind}})
    assert "\n" not in str(told.value)


def test_two_stages_whose_results_are_kept_apart_may_be_of_one_kind():
    kinds = ("closed_form", "baseline", "random", "adaptive", "finalists")
    stages = {name: {} for name in kinds} | {f"second-{name}": {"kind": name} for name in kinds}
    assert len(study(**stages).stages) == 2 * len(kinds)
