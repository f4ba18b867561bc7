"""The rung table decides as Ray's ASHA does, and survives on disk."""

from types import SimpleNamespace

import numpy as np
import pytest
from ray.tune.schedulers import ASHAScheduler

from cconv.study.declared.study_file import rungs_up_to
from cconv.study.records.rungs import RungFile, RungTable
from cconv.study.records.summary import PassedRung


def curves(seed, count=60, full=27):
    """Falling errors of `count` trials at 1 ... full updates."""
    rng = np.random.default_rng(seed)
    start, rate = rng.uniform(0.5, 2, count), rng.uniform(0, 1, count)
    return [start[trial] * np.arange(1, full + 1) ** -rate[trial] for trial in range(count)]


@pytest.mark.parametrize(("full", "grace", "factor"), [(27, 3, 3), (27, 1, 3), (20, 3, 2), (243, 54, 3), (5, 5, 3)])
def test_rungs_rise_by_the_factor_to_the_full_budget(full, grace, factor):
    rungs = rungs_up_to(full, grace, factor)
    assert rungs[0] == grace
    assert rungs[-1] == full
    assert all(later == factor * earlier for earlier, later in zip(rungs[:-2], rungs[1:-1], strict=True))


@pytest.mark.parametrize("factor", [2, 3, 4])
@pytest.mark.parametrize("seed", range(3))
def test_decisions_are_those_of_rays_asha(seed, factor):
    ray = ASHAScheduler(
        time_attr="updates", metric="error", mode="min", max_t=27, grace_period=3, reduction_factor=factor
    )
    table = RungTable(rungs_up_to(27, 3, factor), factor)
    for number, curve in enumerate(curves(seed)):
        trial = SimpleNamespace(trial_id=str(number))
        ray.on_trial_add(None, trial)
        for updates, error in enumerate(curve, start=1):
            goes_on = table.record(str(number), updates, error) and updates < 27
            theirs = ray.on_trial_result(None, trial, {"updates": updates, "error": error})
            assert goes_on == (theirs == "CONTINUE")
            if not goes_on:
                break


def run(table, trials, stop_after=None):
    """Feed trials one after another; after so many evaluations in all, give up, as a kill would."""
    evaluations = 0
    for number, curve in enumerate(trials):
        for updates, error in enumerate(curve, start=1):
            goes_on = table.record(str(number), updates, error)
            evaluations += 1
            if evaluations == stop_after:
                return
            if not goes_on:
                break


@pytest.mark.parametrize("stop_after", [1, 3, 30, 100, 131])
def test_a_table_that_was_left_goes_on_as_if_it_had_not_been(tmp_path, stop_after):
    rungs, trials = rungs_up_to(27, 3, 3), curves(0)
    whole = RungTable(rungs, 3)
    run(whole, trials)
    file = RungFile(tmp_path / "rungs.json")
    cut = file.table("random", rungs, 3)
    run(cut, trials, stop_after)
    file.write("random", cut)
    restored = file.table("random", rungs, 3)
    run(restored, trials)
    assert restored.entries() == whole.entries()


@pytest.mark.parametrize("factor", [2, 3])
@pytest.mark.parametrize("seed", range(3))
def test_those_that_passed_a_rung_are_those_that_went_on_beyond_it(tmp_path, seed, factor):
    file, rungs = RungFile(tmp_path / "rungs.json"), rungs_up_to(27, 3, factor)
    table = RungTable(rungs, factor)
    run(table, curves(seed))
    reached = {entry["updates"]: set(entry["recorded"]) for entry in table.entries()}
    counts = {rung.updates: (rung.trials, rung.passed) for rung in table.passed()}
    assert counts == {
        rung: (len(reached[rung]), len(reached[later])) for rung, later in zip(rungs[:-1], rungs[1:], strict=True)
    }
    file.write("random", table)
    assert file.table("random", rungs, factor).passed() == table.passed()


def test_a_rung_that_no_trial_reached_has_no_share_and_asking_records_nothing():
    table = RungTable([3, 9, 27], 3)
    assert table.passed() == []
    table.record("first", 3, 1.0)
    before = table.entries()
    assert table.passed() == [PassedRung(updates=3, trials=1, passed=1)]
    assert table.entries() == before


def test_stages_share_the_file(tmp_path):
    file = RungFile(tmp_path / "rungs.json")
    for stage in ("random", "adaptive"):
        table = file.table(stage, [3, 9], 3)
        table.record(f"{stage}_0000", 3, 0.5)
        file.write(stage, table)
    assert {stage: rungs[0]["recorded"] for stage, rungs in file.read().items()} == {
        "random": {"random_0000": 0.5},
        "adaptive": {"adaptive_0000": 0.5},
    }
