"""The stage that relaxes: plain first, resumable, within its time, and the choice in a checkpoint of its own."""

from types import SimpleNamespace

import pytest
from summaries import SAMPLE, changed, finalist, minimal_summary
from systems import untrained_step

from cconv.data.dataset import open_dataset
from cconv.errors import ConfigError
from cconv.models.checkpoint import load_model, save_model
from cconv.study.records.relaxations import read_tried
from cconv.study.records.run_folder import RunFolder
from cconv.study.stages import relax
from cconv.study.stages.checked import stability_checks
from cconv.study.stages.relax import RelaxStage
from cconv.study.studies import Study
from cconv.validation import validated

SETTINGS = {"candidates": 2, "starts": 1, "frames": 4}


@pytest.fixture
def session(steps_folder, tmp_path):
    """What the stage needs of a session: a run folder with a summary that recommends an untrained model."""
    run, model = RunFolder(tmp_path / "run"), untrained_step(steps_folder)
    entry, summary = finalist("a"), minimal_summary(RunFolder(SAMPLE).summary())
    save_model(model, run.path / entry.checkpoint, {"valid_error": 1.0})
    about = {"finalists": [entry], "recommended": {"id": "a", "reason": "it is."}}
    run.write_summary(changed(summary, selection=changed(summary.selection, best="a"), **about))
    return SimpleNamespace(
        run=run,
        dataset=open_dataset(steps_folder),
        problem=SimpleNamespace(task=model.task),
        progress=lambda items, _: items,
        seed_of=lambda name: 7,
        load_model=load_model,
    )


def run_stage(session, **settings):
    found = RelaxStage(**SETTINGS | settings).run(session, "relax").relaxed
    assert session.run.summary().relaxed == found
    return found


def test_none_is_tried_first_and_all_is_recorded(session):
    found = run_stage(session)
    tried = found.models["a"].tried
    assert [each.loops for each in tried] == [0, 1, 3]
    assert tried[0].quality == 1
    assert read_tried(session.run, "a") == found.models["a"]
    assert (found.models["a"].frames, found.models["a"].rollouts) == (4, 1)


def test_an_interrupted_stage_goes_on_and_tries_nothing_twice(session, monkeypatch):
    whole = run_stage(session).models["a"].tried

    def fails(*given):
        pytest.fail("a relaxation was tried again")

    monkeypatch.setattr(relax, "_try", fails)
    assert run_stage(session).models["a"].tried == whole
    monkeypatch.undo()
    assert run_stage(session, candidates=3).models["a"].tried[:3] == whole
    assert len(run_stage(session, frames=3, candidates=1).models["a"].tried) == 2  # other rollouts, so all anew


def test_nothing_is_begun_after_the_time_is_up(session):
    tried = run_stage(session, candidates=50, seconds=0.1).models["a"].tried
    assert 2 <= len(tried) < 51
    assert sum(each.seconds for each in tried[1:-1]) <= 0.1


@pytest.mark.parametrize("number", [0, 1])
def test_the_recommended_model_is_offered_with_the_choice_and_without_one_as_it_is(number, session, monkeypatch):
    monkeypatch.setattr(relax, "chosen_relaxation", lambda tried: 1)
    run_stage(session)
    monkeypatch.setattr(relax, "chosen_relaxation", lambda tried: number)
    found, offered = run_stage(session), session.run.summary().offered_checkpoint
    chosen = found.models["a"].tried[number]
    config = load_model(session.run.path / offered).config
    if number:
        assert offered == found.checkpoint == "relaxed"
        assert config.relaxation.model_dump() == chosen.model_dump(include={"alpha", "beta", "loops"})
        assert load_model(session.run.path / finalist("a").checkpoint).config.relaxation is None
    else:
        assert (found.checkpoint, config.relaxation) == (None, None)
        assert not (session.run.path / "relaxed").exists()


def test_the_relaxed_model_is_checked_as_finalists_are(session, monkeypatch):
    monkeypatch.setattr(relax, "chosen_relaxation", lambda tried: 1)
    found = run_stage(session)
    material, checks = stability_checks(session, load_model(session.run.path / "relaxed").cutoff)
    model = load_model(session.run.path / "relaxed")
    assert found.failures == tuple(
        check.in_words(each)
        for check in checks
        for each in check.findings(material.predictor(model))
        if not each.passes
    )
    monkeypatch.setattr(relax, "chosen_relaxation", lambda tried: 0)
    assert run_stage(session).failures is None


def test_a_leap_is_a_recorded_failure_and_never_the_choice(session, monkeypatch):
    monkeypatch.setattr(relax, "propose_relaxation", lambda tried, seed: relax.Relaxation(alpha=1e5))
    found = run_stage(session, candidates=1)
    leap = found.models["a"].tried[1]
    assert leap.diverged == 1
    assert "shifted a particle by" in leap.reason
    assert (found.chosen, found.checkpoint) == ({"a": 0}, None)


def test_a_study_of_a_field_cannot_have_the_stage():
    values = {"name": "a", "task": "density_rate", "search": {"space": "none.toml"}}
    stages = dict.fromkeys(("baseline", "random", "finalists", "select", "relax"), {})
    with pytest.raises(ConfigError, match="stage `relax` is for steps, and 'density_rate' is a field; remove it"):
        validated(Study, values | {"stages": stages}, "a.toml")
    assert validated(Study, values | {"task": "acceleration", "stages": stages}, "a.toml").stages["relax"].starts == 4
