import optuna
from optuna.trial import TrialState

from cconv.study.optuna_mirror import mirror_trials, open_journal
from cconv.study.records import DIVERGED_ERROR, TrialRecord
from cconv.study.space import SearchSpace

SPACE = SearchSpace.model_validate(
    {
        "name": "s",
        "description": "d",
        "parameters": {"kernel_size": {"type": "choice", "values": [3, 4], "baseline": 4, "reason": "r"}},
    }
)


def record(name, errors, outcome):
    log = [{"updates": updates, "valid_normalized_mse": error} for updates, error in errors]
    return TrialRecord(
        id=name, stage="random", parameters={"kernel_size": 4}, config={"num_parameters": 9}, log=log,
        outcome=outcome, reason="",
    )  # fmt: skip


def test_only_the_full_budget_is_complete(tmp_path):
    records = [
        record("full", [(3, 0.9), (9, 0.5)], "completed"),
        record("stopped", [(3, 0.7)], "stopped"),
        record("diverged", [(3, None)], "diverged"),
        record("failed", [], "failed"),
    ]
    mirror_trials(records, SPACE, 9, open_journal(tmp_path / "optuna.journal"), "s")
    study = optuna.load_study(study_name="s", storage=open_journal(tmp_path / "optuna.journal"))
    assert [trial.state for trial in study.trials] == [
        TrialState.COMPLETE,
        TrialState.PRUNED,
        TrialState.PRUNED,
        TrialState.FAIL,
    ]
    assert study.trials[2].intermediate_values == {3: DIVERGED_ERROR}
    assert study.trials[1].intermediate_values == {3: 0.7}
    assert study.best_trial.user_attrs["trial"] == "full"
