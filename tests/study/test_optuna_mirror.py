"""Optuna hears of every trial what its records say, and no trial is left running."""

import optuna
import pytest
from optuna.trial import TrialState

from cconv.errors import ConfigError
from cconv.study.optuna_mirror import OptunaMirror, open_storage
from cconv.study.records import DIVERGED_ERROR
from cconv.study.space import SearchSpace

SPACE = SearchSpace.model_validate(
    {
        "name": "s",
        "description": "d",
        "parameters": {
            "basis": {"type": "choice", "values": ["grid", "radial"], "baseline": "grid", "reason": "r"},
            "kernel_size": {
                "type": "int",
                "range": [3, 5],
                "baseline": 4,
                "reason": "r",
                "when": {"basis": ["grid"]},
            },
        },
    }
)
FULL = 9


def mirror(path, known=()):
    return OptunaMirror(open_storage(path / "optuna.journal"), "s", SPACE, FULL, known)


def trials(path):
    return optuna.load_study(study_name="s", storage=open_storage(path / "optuna.journal")).trials


def entry(updates, error):
    return {"updates": updates, "valid_normalized_mse": error, "diverged": error is None}


def tell(observer, name, errors, outcome, parameters=None):
    observer.on_trial_start(name, parameters or {"basis": "grid", "kernel_size": 4})
    for updates, error in errors:
        observer.on_trial_result(name, entry(updates, error))
    if outcome:
        observer.on_trial_end(name, outcome, "")


def test_only_the_full_budget_is_complete_and_stopped_trials_are_pruned_with_their_last_value(tmp_path):
    observer = mirror(tmp_path)
    tell(observer, "full", [(3, 0.9), (9, 0.5)], "completed", {"basis": "radial"})
    tell(observer, "stopped", [(3, 0.7)], "stopped")
    tell(observer, "diverged", [(3, None)], "diverged")
    tell(observer, "failed", [], "failed")
    full, stopped, diverged, failed = trials(tmp_path)
    assert (full.state, full.value, full.params) == (TrialState.COMPLETE, 0.5, {"basis": "radial"})
    assert (stopped.state, stopped.value, stopped.intermediate_values) == (TrialState.PRUNED, 0.7, {3: 0.7})
    assert (diverged.state, diverged.intermediate_values) == (TrialState.PRUNED, {3: DIVERGED_ERROR})
    assert failed.state == TrialState.FAIL


def test_a_trial_that_a_kill_left_running_goes_on_where_it_is(tmp_path):
    tell(mirror(tmp_path), "a", [(3, 0.9)], None)
    observer = mirror(tmp_path, known=["a"])
    tell(observer, "a", [(3, 0.9), (9, 0.4)], "completed")
    (trial,) = trials(tmp_path)
    assert (trial.state, trial.value, trial.intermediate_values) == (TrialState.COMPLETE, 0.4, {3: 0.9, 9: 0.4})


def test_a_trial_left_running_that_no_record_knows_failed(tmp_path):
    tell(mirror(tmp_path), "lost", [(3, 0.9)], None)
    mirror(tmp_path)
    assert [trial.state for trial in trials(tmp_path)] == [TrialState.FAIL]


def test_an_interrupt_leaves_none_running_and_a_resumed_trial_is_told_anew(tmp_path):
    observer = mirror(tmp_path)
    tell(observer, "a", [(3, 0.9)], None)
    observer.end_running()
    assert [trial.state for trial in trials(tmp_path)] == [TrialState.FAIL]
    tell(mirror(tmp_path, known=["a"]), "a", [(3, 0.9), (9, 0.4)], "completed")
    assert [trial.state for trial in trials(tmp_path)] == [TrialState.FAIL, TrialState.COMPLETE]


def test_a_database_that_is_not_there_is_one_line_without_the_password():
    with pytest.raises(ConfigError, match="--storage") as caught:
        open_storage(None, "postgresql+psycopg2://me:secret@127.0.0.1:1/studies")
    assert "secret" not in str(caught.value)
    assert "\n" not in str(caught.value)


def test_any_database_that_optuna_knows_will_do(tmp_path):
    url = f"sqlite:///{tmp_path / 'studies.db'}"
    tell(OptunaMirror(open_storage(None, url), "s", SPACE, FULL, []), "a", [(9, 0.4)], "completed")
    assert optuna.load_study(study_name="s", storage=url).best_value == 0.4
