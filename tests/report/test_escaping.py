"""Strings from files of others stand in the report as text, never as HTML or script."""

import json
import shutil
from html.parser import HTMLParser

import pytest
from summaries import SAMPLE, changed, rollouts, whole_summary

from cconv.errors import DataError
from cconv.report.fields import read_explanations
from cconv.report.page import render_report
from cconv.study.records.rollouts import write_rollouts
from cconv.study.records.run_folder import RunFolder

pytestmark = pytest.mark.integration

HOSTILE = "</script></style><img src=x onerror=evil()><script>evil()</script>\"'&"


class Elements(HTMLParser):
    """Counts the elements that a browser would build."""

    def __init__(self):
        super().__init__()
        self.images_without_data, self.scripts = 0, []

    def handle_starttag(self, tag, attributes):
        if tag == "img" and not dict(attributes)["src"].startswith("data:image/png;base64,"):
            self.images_without_data += 1
        if tag == "script":
            self.scripts.append("")

    def handle_data(self, data):
        if self.cdata_elem == "script":
            self.scripts[-1] += data


def hostile(summary):
    """A summary whose free texts, and hyperparameters that are texts, are all hostile; names cannot be."""
    hidden = {"window": HOSTILE, HOSTILE: 1}
    findings = [changed(each, label=HOSTILE, detail=HOSTILE) for each in summary.chosen.stability.findings]
    comparisons = [changed(row, why_not=HOSTILE) for row in summary.selection.comparisons]
    finalists = [
        changed(
            entry,
            config=changed(entry.config, parameters=entry.config.parameters | hidden),
            stability=changed(entry.stability, failures=[HOSTILE], findings=findings),
            test=changed(entry.test, in_words=HOSTILE, measures={HOSTILE: 1.0}),
        )
        for entry in summary.finalists
    ]
    task = dict.fromkeys(("symbol", "meaning", "error", "error_meaning"), HOSTILE)
    return changed(
        summary,
        checks=dict.fromkeys(summary.checks, HOSTILE),
        task=changed(summary.task, **task, measures={HOSTILE: HOSTILE}),
        recommended=changed(summary.recommended, reason=f"{HOSTILE}. {HOSTILE}"),
        refined={HOSTILE: HOSTILE},
        failed_finalists={"lost": HOSTILE},
        selection=changed(summary.selection, comparisons=comparisons),
        finalists=finalists,
        search_points=[changed(point, parameters=hidden) for point in summary.search_points],
        budget=HOSTILE,
        explained=(),
    )


@pytest.fixture
def page(tmp_path):
    run = RunFolder(shutil.copytree(SAMPLE, tmp_path / "run", ignore=shutil.ignore_patterns("explanation")))
    run.write_summary(hostile(whole_summary(run.summary())))
    for name in run.summary().rolled:
        found = rollouts(ended=HOSTILE)
        rolled = [changed(each, trajectory=HOSTILE, beyond={HOSTILE: 1}) for each in found.rolled]
        write_rollouts(run, name, changed(found, rolled=rolled, lost=(HOSTILE,)))
    study, environment = run.read("study.json"), run.read("environment.json")
    study["data"]["path"] = HOSTILE
    run.write("study.json", study)
    findings = {"data_findings": [{"line": HOSTILE}]}
    run.write(
        "environment.json", environment | {"processor": HOSTILE, "git_commit": HOSTILE, "python": HOSTILE} | findings
    )
    config = run.path / "trials" / "random_0000" / "config.json"
    known = json.loads(config.read_text())
    config.write_text(json.dumps(known | {"parameters": known["parameters"] | {"window": HOSTILE}}))
    return render_report(run)


def test_no_string_of_a_record_becomes_an_element(page):
    elements = Elements()
    elements.feed(page)
    assert "&lt;img src=x" in page  # in the text
    assert "\\u003cimg src=x" in page  # in the data of the interactive chart
    assert elements.images_without_data == 0
    assert not any(script.strip() == "evil()" for script in elements.scripts)
    assert not any("<img" in script for script in elements.scripts[1:])


def test_damaged_arrays_are_named(tmp_path):
    (tmp_path / "explanation").mkdir()
    for content in (b"", b"PK\x03\x04", b"no archive"):
        (tmp_path / "explanation" / "baseline.npz").write_bytes(content)
        with pytest.raises(DataError, match=r"baseline\.npz: no arrays"):
            read_explanations(RunFolder(tmp_path), ["baseline"])
