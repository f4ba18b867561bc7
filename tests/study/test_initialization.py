"""The initialisation stage: seeds of its own, and variances that are what they say."""

import numpy as np
import pytest

from cconv.study.initialization import STAGE, _compare, variance_decomposition
from cconv.study.records import RunFolder


@pytest.fixture
def run(finished_run):
    return RunFolder.open(finished_run)


def test_the_baseline_is_trained_with_seeds_that_no_other_stage_uses(run):
    own = [record for record in run.trials() if record.stage == STAGE]
    baseline = next(record for record in run.trials() if record.id == "random_0000")
    others = {record.config["init_seed"] for record in run.trials() if record.stage != STAGE}
    others |= {record.config["init_seed"] for records in run.retrainings().values() for record in records}
    assert len({record.config["init_seed"] for record in own} - others) == len(own) == 2
    assert all(record.parameters == baseline.parameters for record in own)
    assert all(record.outcome == "completed" for record in own)


def test_each_rung_compares_seeds_with_configurations(run):
    entries = variance_decomposition(run)
    rungs = {rung["updates"]: rung["recorded"] for rung in run.read("rungs.json")["random"]}
    assert entries == run.read("summary.json")["initialization"]
    assert entries
    for entry in entries:
        errors = np.log10(list(rungs[entry["updates"]].values()))
        assert entry["configurations"] == len(errors)
        assert entry["configuration_spread"] == pytest.approx(errors.std(ddof=1))
        low, high = entry["seed_share_ci95"]
        assert low < entry["seed_share"] < high


def test_the_interval_covers_the_true_share_nineteen_times_of_twenty():
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(1000):
        entry = _compare(rng.normal(0, 0.1, 6), rng.normal(0, 0.2, 15))
        low, high = entry["seed_share_ci95"]
        covered += low <= 0.25 <= high
    assert 0.93 < covered / 1000 < 0.97


def test_configurations_without_spread_have_no_share():
    assert _compare([0.1, 0.2], [0.3, 0.3])["seed_share"] is None
