"""Optuna hears of every trial what its records say, and no trial is left running."""

import optuna
import pytest
from optuna.trial import TrialState

from cconv.errors import ConfigError
from cconv.study.declared.domains import SearchSpace
from cconv.study.records.trials import DIVERGED_ERROR, TrialRecord
from cconv.study.running.optuna_mirror import OptunaMirror, open_mirror, open_storage

SPACE = SearchSpace.model_validate(
    {
        "name": "s",
        "description": "d",
        "parameters": {
            "architecture": {
                "type": "choice",
                "values": ["conv_net", "radial_net"],
                "baseline": "conv_net",
                "reason": "r",
            },
            "kernel_size": {
                "type": "int",
                "range": [3, 5],
                "baseline": 4,
                "reason": "r",
                "when": {"architecture": ["conv_net"]},
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
    return {"updates": updates, "valid_error": error, "diverged": error is None}


def tell(observer, name, errors, outcome, parameters=None):
    observer.on_trial_start(name, parameters or {"architecture": "conv_net", "kernel_size": 4})
    for updates, error in errors:
        observer.on_trial_result(name, entry(updates, error))
    if outcome:
        observer.on_trial_end(name, outcome, "")


def test_only_the_full_budget_is_complete_and_stopped_trials_are_pruned_with_their_last_value(tmp_path):
    observer = mirror(tmp_path)
    tell(observer, "full", [(3, 0.9), (9, 0.5)], "completed", {"architecture": "radial_net"})
    tell(observer, "stopped", [(3, 0.7)], "stopped")
    tell(observer, "diverged", [(3, None)], "diverged")
    tell(observer, "failed", [], "failed")
    full, stopped, diverged, failed = trials(tmp_path)
    assert (full.state, full.value, full.params) == (TrialState.COMPLETE, 0.5, {"architecture": "radial_net"})
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


def record(name, errors, outcome):
    log = [entry(updates, error) for updates, error in errors]
    parameters = {"architecture": "conv_net", "kernel_size": 4}
    return TrialRecord(id=name, stage="random", parameters=parameters, config={}, log=log, outcome=outcome, reason="")


RECORDS = [
    record("full", [(3, 0.9), (9, 0.5)], "completed"),
    record("stopped", [(3, 0.7)], "stopped"),
    record("failed", [], "failed"),
    record("cut", [(3, 0.6)], "interrupted"),
]
DAMAGE = {
    "garbage line": lambda whole: whole + b"garbage\n",
    "half a line": lambda whole: whole[: len(whole) * 2 // 3],
    "NUL bytes": lambda whole: whole[:-20] + bytes(20),
    "a line of another program": lambda whole: b"{}\n" + whole,
    "nothing": lambda whole: b"",
    "lost trials": lambda whole: b"".join(whole.splitlines(keepends=True)[:1]),
    "deep nesting": lambda whole: whole + b"[" * 100_000 + b"\n",
}


def reopened(path):
    return open_mirror(path / "optuna.journal", None, "s", SPACE, FULL, RECORDS)


def told(path):
    return [(trial.user_attrs["trial"], trial.state, trial.intermediate_values) for trial in trials(path)]


TOLD = [
    ("full", TrialState.COMPLETE, {3: 0.9, 9: 0.5}),
    ("stopped", TrialState.PRUNED, {3: 0.7}),
    ("failed", TrialState.FAIL, {}),
    ("cut", TrialState.RUNNING, {3: 0.6}),
]


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_journal_is_written_anew_from_the_records(damage, tmp_path):
    reopened(tmp_path)
    journal = tmp_path / "optuna.journal"
    journal.write_bytes(damage(journal.read_bytes()))
    tell(reopened(tmp_path), "cut", [(9, 0.4)], "completed")
    assert told(tmp_path) == [*TOLD[:3], ("cut", TrialState.COMPLETE, {3: 0.6, 9: 0.4})]


def test_a_whole_journal_is_gone_on_with(tmp_path):
    reopened(tmp_path)
    before = (tmp_path / "optuna.journal").read_bytes()
    reopened(tmp_path)
    assert (tmp_path / "optuna.journal").read_bytes().startswith(before)
    assert told(tmp_path) == TOLD


def test_a_lock_left_behind_does_not_stop_a_study(tmp_path):
    (tmp_path / "optuna.journal.lock").symlink_to(tmp_path / "optuna.journal")
    reopened(tmp_path)
    assert told(tmp_path) == TOLD


def test_a_folder_in_place_of_the_journal_is_replaced(tmp_path):
    (tmp_path / "optuna.journal").mkdir()
    reopened(tmp_path)
    assert told(tmp_path) == TOLD
