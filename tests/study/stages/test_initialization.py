"""The initialisation stage: seeds of its own, trainings that nothing stops, and what they tell."""

import pytest

from cconv.study.evidence.seed_variance import variance_decomposition
from cconv.study.records.run_folder import RunFolder
from cconv.study.stages.initialization import by_purpose


@pytest.fixture
def run(finished_run):
    return RunFolder.open(finished_run)


def test_the_baseline_is_trained_with_seeds_that_no_other_stage_uses(run):
    seeds, configurations = by_purpose(run, "initialization", 0)
    others = {record.config["init_seed"] for record in run.trials() if record not in seeds}
    others |= {record.config["init_seed"] for records in run.retrainings().values() for record in records}
    assert len({record.config["init_seed"] for record in seeds} - others) == len(seeds) == 2
    (baseline,) = run.trials_of("baseline")
    assert all(record.parameters == baseline.parameters for record in seeds)
    assert len({str(record.parameters) for record in configurations}) == len(configurations) == 4


def test_nothing_was_stopped(run):
    assert {record.outcome for record in run.trials_of("initialization")} <= {"completed", "diverged"}


def test_the_summary_holds_what_the_records_say(run):
    seeds, configurations = by_purpose(run, "initialization", 0)
    summary = run.summary()
    assert list(summary.initialization) == variance_decomposition(seeds, configurations, [6, 18])
    assert [entry.updates for entry in summary.rung_audit] == [6]
    assert {entry.strategy for entry in summary.strategies} == {"asha", "little_each", "no_stopping"}
