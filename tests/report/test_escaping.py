"""Strings from files of others stand in the report as text, never as HTML or script."""

import copy
import json
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest
from summaries import whole_summary

from cconv.errors import DataError
from cconv.report.fields import read_explanations
from cconv.report.page import render_report
from cconv.study.records.run_folder import RunFolder

pytestmark = pytest.mark.integration

SAMPLE = Path(__file__).parents[2] / "analysis" / "sample_run"
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
    """A summary whose free texts, and hyperparameters that are texts, are all hostile."""
    summary = copy.deepcopy(summary)
    summary["recommended"]["reason"] = f"{HOSTILE}. {HOSTILE}"
    summary["refined"] = {HOSTILE: HOSTILE}
    summary["failed_finalists"] = {HOSTILE: HOSTILE}
    summary["selection"]["rule"] = HOSTILE
    summary["checks"] = dict.fromkeys(summary["checks"], HOSTILE)
    for row in summary["selection"]["comparisons"]:
        row["why_not"] = HOSTILE
    for entry in summary["finalists"]:
        entry["config"]["parameters"] |= {"window": HOSTILE, HOSTILE: HOSTILE}
        entry["stability"]["failures"] = [HOSTILE]
        entry["stability"]["findings"][0] |= {"label": HOSTILE, "detail": HOSTILE}
    for point in summary["search_points"]:
        point["parameters"] = {"window": HOSTILE, HOSTILE: 1}
    return summary


@pytest.fixture
def page(tmp_path):
    run = RunFolder(shutil.copytree(SAMPLE, tmp_path / "run", ignore=shutil.ignore_patterns("explanation")))
    run.write("summary.json", hostile(whole_summary(run.read("summary.json"))))
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
            read_explanations(RunFolder(tmp_path))
