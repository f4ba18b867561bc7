"""The importance stage counts errors up to that of predicting the mean, or that which trials are given up above."""

from types import SimpleNamespace

import pytest
from studies import Silent, begin_search, write_search

from cconv.models.errors import mean_predictor_error, normalized_mse
from cconv.study.evidence import importance
from cconv.study.pipeline import _session
from cconv.study.records.found import Found
from cconv.study.stages.importance import ImportanceStage
from cconv.study.studies import recorded_space, recorded_study


@pytest.mark.parametrize(("given_up_above", "useless"), [(10.0, 4.5), (2.0, 2.0)])
def test_errors_are_clipped_at_the_smaller_of_both(given_up_above, useless, monkeypatch):
    seen = []
    monkeypatch.setattr(importance, "importance_by_rung", lambda *_, **settings: (seen.append(settings), [])[1])
    session = SimpleNamespace(
        read=lambda name: [],
        space=None,
        seed_of=lambda name: 0,
        useless_error=4.5,
        study=SimpleNamespace(rungs=[10], search=SimpleNamespace(give_up_above=given_up_above)),
    )
    assert ImportanceStage().run(session, "importance") == Found(importance=[])
    assert seen[0]["useless_error"] == useless


@pytest.mark.integration
def test_a_study_knows_the_mean_predictors_own_error_on_the_validation_split(flow_folder, tmp_path):
    """Which is not 1, as on the training split."""
    study_file = write_search(tmp_path, "clipped", concurrency=1, random=1, adaptive=1)
    run = begin_search(study_file, flow_folder, tmp_path / "run")
    study, space = recorded_study(run), recorded_space(run)
    with _session(study, space, run, Silent(), lambda items, _: items, None, None, serial=True) as session:
        problem = session.problem
        own = normalized_mse(mean_predictor_error(problem.valid_samples, problem.train_samples))
        assert abs(own - 1) > 0.01
        assert session.useless_error == pytest.approx(own)
