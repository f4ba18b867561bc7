"""Tables of a run: a row for each thing recorded, and nothing lost."""

import math
import subprocess
import sys

import pytest
from summaries import SAMPLE, changed, minimal_summary, whole_summary

from cconv.report.tables import (
    ANALYTIC,
    MEAN_PREDICTOR,
    curves_table,
    end_of_bar,
    error_interval,
    finalists_table,
    growth_table,
    importance_table,
    rung_audit_table,
    speed_accuracy_table,
    strategies_table,
    trials_table,
)
from cconv.report.verdicts import ALL, checks_table, failures_table, verdict_matrix, verdicts_table
from cconv.study.records.run_folder import RunFolder


@pytest.fixture
def run():
    return RunFolder(SAMPLE)


@pytest.fixture
def summary():
    return whole_summary(RunFolder(SAMPLE).summary())


def test_trials_table_has_a_row_a_trial_and_its_hyperparameters(run):
    table = trials_table(run)
    assert list(table["trial"]) == [record.id for record in run.trials()]
    assert {"network.kernel_size", "network.message", "training.learning_rate", "outcome", "num_parameters"} <= set(
        table.columns
    )


def test_curves_table_has_a_row_an_evaluation(run):
    table = curves_table(run)
    records = [*run.trials(), *(record for records in run.retrainings().values() for record in records)]
    assert len(table) == sum(len(record.log) for record in records)
    assert (table["valid_error"] > 0).all()


def test_finalists_table_is_sorted_by_error_between_exact_and_trivial(summary):
    table = finalists_table(summary)
    assert table["test_error"].is_monotonic_increasing
    assert set(table["model"]) == {entry.id for entry in summary.finalists} | {ANALYTIC, MEAN_PREDICTOR}
    trivial, exact = (table[table["model"] == name].iloc[0] for name in (MEAN_PREDICTOR, ANALYTIC))
    assert (trivial["valid_error"], trivial["test_error"]) == (4.5, 1.58)
    assert (exact["test_error"], exact["ms_per_frame"]) == (0, summary.analytic.ms_per_frame)


def test_intervals_hold_the_error_or_are_empty(summary):
    first, *others = summary.finalists
    test = changed(first.test, ci95=None, why_no_interval="2 units say too little")
    summary = changed(summary, finalists=[changed(first, test=test), *others])
    for table, value, low, high in (
        (finalists_table(summary), "test_error", "ci95_low", "ci95_high"),
        (speed_accuracy_table(summary).query("kind == 'finalist'"), "error", "error_low", "error_high"),
    ):
        known = table[table[low].notna()]
        assert len(known) == len(summary.finalists) - 1
        assert (known[low] <= known[value]).all()
        assert (known[value] <= known[high]).all()


def test_speed_accuracy_table_has_every_point_with_an_error_once(summary):
    table = speed_accuracy_table(summary)
    assert list(table["kind"].unique()) == ["finalist", "search", "analytic"]
    assert list(table.loc[table["kind"] == "finalist", "name"]) == [entry.id for entry in summary.finalists]
    assert list(table.loc[table["kind"] == "search", "name"]) == [point.id for point in summary.search_points]
    assert set(table.loc[table["on_front"], "name"]) == set(summary.pareto_front)
    assert table.loc[table["name"] == ANALYTIC, "error"].item() == 0
    assert table["ms"].notna().all()


def test_marked_finalists_have_groups_of_their_own(summary):
    marked = ("baseline", summary.recommended.id)
    others = [changed(entry, id="thesis_best") for entry in summary.finalists if entry.id not in marked]
    summary = changed(summary, finalists=[*map(summary.finalist, marked), others[0]])
    groups = speed_accuracy_table(summary).set_index("name")["group"]
    assert groups["baseline"] == "baseline"
    assert groups["thesis_best"] == "thesis's best"
    assert groups[summary.recommended.id] == "recommended"


def test_tables_of_parts_have_a_row_a_record(summary):
    growth, audit, strategies = growth_table(summary), rung_audit_table(summary), strategies_table(summary)
    assert len(growth) == 2 * len(summary.finalists)
    assert list(audit["updates"]) == [15, 45, 135]
    assert list(audit["spearman_low"] < audit["spearman"]) == [False, True, True]
    assert list(audit["why_no_interval"] == "") == [False, True, True]
    assert list(strategies["strategy"]) == ["random, ASHA", "random, ASHA", "random, a little each"]
    assert importance_table(()).empty
    assert rung_audit_table(minimal_summary(summary)).empty


def test_importances_have_a_row_a_rung_and_hyperparameter_where_they_are_known(summary):
    table = importance_table(summary.importance)
    assert list(table["updates"]) == [45, 45, 45, 135, 135, 135]
    assert list(table["hyperparameter"])[:3] == ["network.layers", "network.window", "network.message"]
    tested = table[table["share"].notna()]
    assert (tested["low"] <= tested["share"]).all()
    assert (tested["share"] <= tested["high"]).all()


def test_verdicts_agree_with_the_limits(summary):
    rows = {(row.check, row.label): row for row in verdict_matrix(summary)}
    errors = [entry.test.error for entry in summary.finalists]
    assert [cell.passes for cell in rows["stress", "clumped"].cells] == [error <= 0.05 for error in errors]
    assert rows["regimes", "near wall"].limit == 0.5
    assert {cell.detail for cell in rows["regimes", "near wall"].cells} == {"10 % of particles"}


def test_tables_of_verdicts_say_the_same_as_the_matrix(summary):
    table = verdicts_table(summary).set_index(["check", "label"])
    for row in verdict_matrix(summary):
        assert list(table.loc[(row.check, row.label)].iloc[1:]) == [f"{cell.value:.3g}" for cell in row.cells]
    assert set(checks_table(summary)["check"]) == set(table.index.get_level_values("check")) - {ALL}
    failed = [entry.id for entry in summary.finalists if not entry.stability.stable]
    assert [name for name in table.columns[1:] if table.loc[(ALL, "passes every check"), name] == "no"] == failed
    assert list(failures_table(summary)["model"]) == failed


@pytest.mark.integration
def test_what_notebooks_import_needs_neither_ray_nor_torch():
    modules = (
        "tables",
        "decidable",
        "plots",
        "fields",
        "verdicts",
        "speed_accuracy",
        "interactive",
        "importance_plots",
        "page",
    )
    imports = ", ".join(f"cconv.report.{name}" for name in modules)
    code = f"import sys, {imports}; print({{'ray', 'torch'}} & set(sys.modules))"
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert finished.stdout.strip() == "set()"


def test_an_interval_of_errors_without_an_upper_end_says_so():
    assert error_interval(1.5e-6, 2e-5) == "1.5e-06 to 2e-05"
    assert error_interval(3.35e-6, 4.49e9) == "at least 3.35e-06"
    assert error_interval(0.0, 0.0) == "0 to 0"
    assert end_of_bar(2e-6, 1.5e-6, 2e-5) == 2e-5
    assert end_of_bar(2e-6, 1.5e-6, 4.49e9) == end_of_bar(2e-6, math.nan, math.nan) == 2e-6
