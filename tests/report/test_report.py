"""The report of finished, interrupted and failed runs."""

import re
import shutil

import pytest
from summaries import SAMPLE, changed, minimal_summary, relaxations, whole_run_in

from cconv.report import page
from cconv.report.page import render_report, write_report
from cconv.report.sections import SECTIONS, chart
from cconv.study.records.run_folder import RunFolder

pytestmark = pytest.mark.integration


@pytest.fixture
def run(tmp_path):
    """A copy of the committed run with no more than every study finds."""
    run = RunFolder(shutil.copytree(SAMPLE, tmp_path / "run"))
    run.write_summary(minimal_summary(run.summary()))
    return run


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory):
    """A copy of the committed run with everything that a study may find."""
    return whole_run_in(tmp_path_factory.mktemp("whole"))


@pytest.fixture
def other_run(whole_run, tmp_path):
    """A copy of the whole run that a test may write to."""
    return RunFolder(shutil.copytree(whole_run.path, tmp_path / "other"))


@pytest.fixture
def no_charts(monkeypatch):
    """Draw nothing, which takes most of the time."""
    monkeypatch.setattr(page, "_png", lambda figure: "")
    monkeypatch.setattr(chart, "interactive_html", lambda summary: "")


@pytest.fixture(scope="module")
def whole_report(whole_run):
    return write_report(whole_run).read_text()


def without_scripts(text):
    return re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)


def sections(text):
    return re.findall(r'<h2 id="(\w+)"', text)


def test_a_report_shows_the_recommendation_and_every_finalist(run, no_charts):
    text, summary = render_report(run), run.summary()
    assert summary.recommended.reason.split(" (")[0] in text
    for entry in summary.finalists:
        assert f"{entry.test.error:.4g}" in text


def test_a_report_has_a_section_for_everything_that_was_recorded(whole_report):
    assert sections(whole_report) == [section.name for section in SECTIONS]
    for figure in (
        "95 % interval 7.21 to 7.93",
        "22.4 %",
        "4.21",
        "1.03",
        "unreliable",
        "less accurate than the",
        "walls added",
        "density left out",
        "still falling",
        "Dρ/Dt",
    ):
        assert figure in whole_report


def words(text):
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", "", without_scripts(text)))


def test_the_answer_says_what_it_was_chosen_by_and_what_is_reported(whole_run, whole_report):
    chosen, text = whole_run.summary().chosen, words(whole_report)
    assert "The choice was made by validation errors" in text
    assert f"a normalized MSE of {chosen.test.error:.3g} (95 % interval" in text
    assert "has 1.58 on the test split" in text
    assert "has a test error of 0.0321" in text
    assert whole_report.count("<td>predicting the mean</td>") == 3  # finalists, comparisons, trials


def test_the_share_of_trials_that_passed_each_rung_is_said_beside_that_which_the_rule_aims_at(whole_run, whole_report):
    text, stages = words(whole_report), [*whole_run.summary().rungs.values()]
    assert any(stages)
    assert all(f"({rung.passed} of {rung.trials})" in text for rungs in stages for rung in rungs)
    assert "The rule aims at 33 %" in text


@pytest.mark.parametrize(("ms", "says"), [(1e-3, True), (1e3, False)])
def test_the_answer_says_where_analytic_sph_is_cheaper_and_exact(other_run, ms, says, no_charts):
    summary = other_run.summary()
    other_run.write_summary(changed(summary, analytic=changed(summary.analytic, ms_per_frame=ms)))
    assert ("It is cheaper than the recommended model, and exact" in words(render_report(other_run))) == says


@pytest.mark.parametrize(("failures", "says"), [((), True), (("too dense 0.1 (limit 0.02)",), False)])
def test_the_report_says_whether_the_relaxed_model_is_stable(other_run, failures, says, no_charts):
    summary = other_run.summary()
    shaky = changed(summary.chosen, stability=changed(summary.chosen.stability, stable=False, failures=("x",)))
    finalists = [shaky if entry.id == shaky.id else entry for entry in summary.finalists]
    relaxed = changed(relaxations(summary.recommended.id), failures=failures)
    other_run.write_summary(changed(summary, finalists=finalists, relaxed=relaxed))
    text = words(render_report(other_run))
    assert ("Relaxed, it is stable" in text) == says
    assert ("it passes every check of stability, which it does not without" in text) == says
    assert all(failure in text for failure in failures)


def test_analytic_sph_and_the_densitys_symbols_are_not_spoken_of_where_the_task_has_none(run, no_charts):
    summary = run.summary()
    words_of_task = {"symbol": "x", "meaning": "The next frame.", "error": "mean squared shift", "error_meaning": ""}
    task = changed(summary.task, name="next_frame", measures={}, **words_of_task)
    run.write_summary(changed(summary, task=task))
    text = words(render_report(run))
    assert "has a mean squared shift of" in text
    assert not [word for word in ("Dρ/Dt", "∇ρ", "normalized MSE", "nalytic SPH") if word in text]


def test_an_exact_model_has_no_ratio_of_errors(run):
    summary = run.summary()
    exact = changed(summary.chosen, test=changed(summary.chosen.test, error=0.0, ci95=(0.0, 0.0)))
    finalists = [exact if entry.id == exact.id else entry for entry in summary.finalists]
    run.write_summary(changed(summary, finalists=finalists))
    text = words(render_report(run))
    assert "has a normalized MSE of 0 (" in text
    assert "The baseline takes " in text
    assert "times the error" not in text


def test_an_interval_that_is_not_given_has_its_reason(run, no_charts):
    summary, none = run.summary(), {"ci95": None, "why_no_interval": "2 units say too little of others"}
    finalists = [changed(entry, test=changed(entry.test, **none)) for entry in summary.finalists]
    run.write_summary(changed(summary, finalists=finalists))
    text = words(render_report(run))
    assert "(no interval: 2 units say too little of others)" in text
    assert "95 % interval 0" not in text


def test_what_the_trials_can_decide_is_said_before_the_bars(whole_report):
    text, alt = without_scripts(whole_report), "Importance of hyperparameters by rung"
    can = "with 16 trials and 3 hyperparameters, only a hyperparameter that decides at least 62 % of the variance"
    assert 0 < text.index(can) < text.index(alt)
    assert "After 15 updates no importance is given: 15 of 16 trials are no better than predicting the mean." in text
    assert "Found: network.layers (40 %, 95 % interval 30 to 50 %)." in text


def test_without_any_importance_the_reason_stands_in_place_of_the_chart(other_run, no_charts):
    summary = other_run.summary()
    unknown = [entry for entry in summary.importance if entry.why_none]
    other_run.write_summary(changed(summary, importance=unknown, partial_dependence=()))
    text = render_report(other_run)
    assert "importance" in sections(text)
    assert "After 15 updates no importance is given" in text
    assert "Importance of hyperparameters by rung" not in text
    assert "Table of all shares" not in text


def test_every_section_says_what_is_to_be_seen_and_every_link_has_its_place(whole_report):
    text = without_scripts(whole_report)
    parts = re.split(r"<h[23][^>]*>", text)[1:]
    assert all(re.search(r"<(p|dl|div)[ >]", part) for part in parts)
    targets = set(re.findall(r'href="#(\w+)"', text))
    assert targets <= set(sections(text))


def test_a_report_opens_without_a_network(whole_report):
    assert not re.findall(r"""<(?:script|link|img)[^>]+(?:src|href)=["'](?!data:)""", whole_report)
    assert not re.findall(r"""(?:src|href)=["'](?!data:|#)""", without_scripts(whole_report))
    assert whole_report.count("plotly.js v") <= 1


def test_what_was_recorded_cannot_write_html(run, no_charts):
    summary = run.summary()
    reason = "<script>alert('it')</script>"
    run.write_summary(changed(summary, recommended=changed(summary.recommended, reason=reason)))
    assert "<script>alert" not in write_report(run).read_text()


def test_a_run_whose_baseline_failed_has_a_report_that_says_so(run, no_charts):
    summary = run.summary()
    finalists = [entry for entry in summary.finalists if entry.id != "baseline"]
    failed = {"baseline": "seed_1 failed out of memory"}
    run.write_summary(changed(summary, finalists=finalists, failed_finalists=failed))
    assert "seed_1 failed out of memory" in write_report(run).read_text()


def test_suspicious_data_are_said_before_everything_else(run, no_charts):
    line = "trajectory train/00000, frame 0, particle 5: mass 0 is not positive"
    run.write("environment.json", run.read("environment.json") | {"data_findings": [{"line": line}]})
    page = render_report(run)
    assert 0 < page.index(line) < page.index('id="answer"')


def test_an_interrupted_run_has_a_report_too(run):
    (run.path / "summary.json").unlink()
    run.write("state.json", {"state": "interrupted", "stage": "finalists"})
    shutil.rmtree(run.path / "finalists")
    text = write_report(run).read_text()
    assert "interrupted" in text
    assert text.count("data:image/png;base64,") == 2
    assert sections(text) == ["search", "space", "provenance", "glossary"]


def test_a_run_without_any_trial_has_a_report_too(run, tmp_path):
    empty = RunFolder(tmp_path / "empty")
    for name in ("study.json", "space.json"):
        empty.write(name, run.read(name))
    empty.write("state.json", {"state": "failed", "stage": "data"})
    assert "failed" in write_report(empty).read_text()


def test_a_finished_study_has_a_report(finished_run, tmp_path):
    own_run = shutil.copytree(finished_run, tmp_path / "own")  # others read the run itself
    run = RunFolder.open(own_run)
    assert run.summary().recommended.id in write_report(run).read_text()
