"""The report of whole, old, interrupted and failed runs."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from summaries import explanation, whole_summary

from cconv.report import page
from cconv.report.page import render_report, write_report
from cconv.study.records.run_folder import RunFolder

pytestmark = pytest.mark.integration

SAMPLE = Path(__file__).parents[2] / "analysis" / "sample_run"
OPTIONAL = (
    "search_points", "analytic", "front", "growth", "rung_audit", "references", "importance", "ablation", "selection",
    "initialization", "refined", "partial_dependence",
)  # fmt: skip


def old_run(folder):
    """A run whose summary has no more than any version of the summary has."""
    run = RunFolder(shutil.copytree(SAMPLE, folder / "run", ignore=shutil.ignore_patterns("explanation")))
    summary = {key: value for key, value in run.read("summary.json").items() if key not in OPTIONAL}
    for entry in summary["finalists"]:
        entry["stability"] = None
    run.write("summary.json", summary)
    return run


@pytest.fixture
def run(tmp_path):
    return old_run(tmp_path)


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory):
    """A run with everything that can be recorded."""
    run = old_run(tmp_path_factory.mktemp("whole"))
    run.write("summary.json", whole_summary(run.read("summary.json")))
    (run.path / "explanation").mkdir(exist_ok=True)
    for name in {run.read("summary.json")["recommended"]["id"], "baseline"}:
        np.savez(run.path / "explanation" / f"{name}.npz", **explanation())
    return run


@pytest.fixture(scope="module")
def whole_report(whole_run):
    return write_report(whole_run).read_text()


def without_scripts(text):
    return re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)


def sections(text):
    return re.findall(r'<h2 id="(\w+)"', text)


def test_old_summaries_have_a_report(run):
    text = write_report(run).read_text()
    summary = run.read("summary.json")
    assert summary["recommended"]["reason"].split(" (")[0] in text
    for entry in summary["finalists"]:
        assert f"{entry['test']['normalized_mse']:.4g}" in text
    assert sections(text) == ["answer", "chart", "finalists", "budget", "cost", "search", "provenance", "glossary"]


def test_a_report_has_a_section_for_everything_that_was_recorded(whole_report):
    assert sections(whole_report) == [
        "answer", "chart", "finalists", "sure", "budget", "stability", "cost", "search", "importance", "ablation",
        "learned", "provenance", "glossary",
    ]  # fmt: skip
    for figure in (
        "95 % interval 7.21 to 7.93",
        "22.4 %",
        "4.21",
        "1.03",
        "loses good trials",
        "less accurate than the",
        "dense left out",
        "walls added",
        "density left out",
    ):
        assert figure in whole_report


def words(text):
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", "", without_scripts(text)))


def test_the_answer_says_what_it_was_chosen_by_and_what_is_reported(whole_run, whole_report):
    summary, text = whole_run.read("summary.json"), words(whole_report)
    chosen = next(each for each in summary["finalists"] if each["id"] == summary["recommended"]["id"])
    assert "The choice was made by validation errors" in text
    assert f"a normalized MSE of {chosen['test']['normalized_mse']:.3g} (95 % interval" in text
    assert "has 1.58 on the test split" in text
    assert "has a test error of 0.0321" in text
    assert whole_report.count("<td>predicting the mean</td>") == 3  # finalists, comparisons, trials


@pytest.mark.parametrize(("ms", "says"), [(1e-3, True), (1e3, False)])
def test_the_answer_says_where_analytic_sph_is_cheaper_and_exact(whole_run, ms, says, monkeypatch):
    monkeypatch.setattr(page, "_picture", lambda figure: "")
    monkeypatch.setattr(page, "interactive_html", lambda summary: "")
    before = whole_run.read("summary.json")
    whole_run.write("summary.json", before | {"analytic": before["analytic"] | {"ms_per_frame": ms}})
    assert ("It is cheaper than the recommended model, and exact" in words(render_report(whole_run))) == says
    whole_run.write("summary.json", before)


def test_an_interval_that_is_not_given_has_its_reason(run, monkeypatch):
    monkeypatch.setattr(page, "_picture", lambda figure: "")
    summary = run.read("summary.json")
    for entry in summary["finalists"]:
        entry["test"] |= {"ci95": None, "why_no_interval": "2 units say too little of others"}
    run.write("summary.json", summary)
    text = words(render_report(run))
    assert "(no interval: 2 units say too little of others)" in text
    assert "95 % interval 0" not in text


def test_each_optional_part_can_be_missing(run, whole_run, monkeypatch):
    monkeypatch.setattr(page, "_picture", lambda figure: "")
    monkeypatch.setattr(page, "interactive_html", lambda summary: "")
    summary = whole_run.read("summary.json")
    for key in [*OPTIONAL, "failed_finalists"]:
        run.write("summary.json", {name: value for name, value in summary.items() if name != key})
        assert "answer" in sections(render_report(run))


def test_what_the_trials_can_decide_is_said_before_the_bars(whole_report):
    text, alt = without_scripts(whole_report), "Importance of hyperparameters by rung"
    can = "with 16 trials and 3 hyperparameters, only a hyperparameter that decides at least 62 % of the variance"
    assert 0 < text.index(can) < text.index(alt)
    assert "After 15 updates no importance is given: 15 of 16 trials are no better than predicting the mean." in text
    assert "Found: layers (40 %, 95 % interval 30 to 50 %)." in text


def test_without_any_importance_the_reason_stands_in_place_of_the_chart(whole_run, monkeypatch):
    monkeypatch.setattr(page, "_picture", lambda figure: "")
    monkeypatch.setattr(page, "interactive_html", lambda summary: "")
    before = whole_run.read("summary.json")
    unknown = [entry for entry in before["importance"] if entry["why_none"]]
    whole_run.write("summary.json", before | {"importance": unknown, "partial_dependence": None})
    text = render_report(whole_run)
    whole_run.write("summary.json", before)
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


def test_what_was_recorded_cannot_write_html(run):
    summary = run.read("summary.json")
    summary["recommended"]["reason"] = "<script>alert('it')</script>"
    run.write("summary.json", summary)
    assert "<script>alert" not in write_report(run).read_text()


def test_a_run_whose_baseline_failed_has_a_report_that_says_so(run):
    summary = run.read("summary.json")
    summary["finalists"] = [entry for entry in summary["finalists"] if entry["id"] != "baseline"]
    other = summary["finalists"][0]["id"]
    summary |= {"pareto_front": [other], "recommended": {"id": other, "reason": "alone"}}
    summary["failed_finalists"] = {"baseline": "seed_1 failed out of memory"}
    run.write("summary.json", summary)
    assert "seed_1 failed out of memory" in write_report(run).read_text()


def test_suspicious_data_are_said_before_everything_else(run):
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
    assert sections(text) == ["search", "provenance", "glossary"]


def test_a_run_without_any_trial_has_a_report_too(run, tmp_path):
    empty = RunFolder(tmp_path / "empty")
    for name in ("study.json", "space.json"):
        empty.write(name, run.read(name))
    empty.write("state.json", {"state": "failed", "stage": "data"})
    assert "failed" in write_report(empty).read_text()


def test_a_finished_study_has_a_report(finished_run, tmp_path):
    summary = json.loads((finished_run / "summary.json").read_text())
    own_run = shutil.copytree(finished_run, tmp_path / "own")  # others read the run itself
    text = write_report(RunFolder.open(own_run)).read_text()
    assert summary["recommended"]["id"] in text
    assert f"{len(summary['finalists'])}" in text
