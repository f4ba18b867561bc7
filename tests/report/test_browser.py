"""A report opens in a browser without errors, and nothing in it is wider than a phone's screen."""

import json
import re
import shutil
import subprocess

import pytest
from processes import PATIENCE
from summaries import SAMPLE, compared_steps

from cconv.report.compared_runs import compared_runs
from cconv.report.comparison import write_comparison
from cconv.report.page import render_report
from cconv.study.records.run_folder import RunFolder

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
WATCHES = """<script>
var problems = [];
addEventListener("error", event => problems.push(event.message));
console.error = (...words) => problems.push(words.join(" "));
</script>"""
TELLS = """<script>
addEventListener("load", () => setTimeout(() => {
  const page = document.documentElement;
  parent.postMessage(JSON.stringify({problems: problems, screen: page.clientWidth, page: page.scrollWidth}), "*");
}, 500));
</script>"""
# Windows of a browser are 500 pixels wide at least, frames in them are not.
SCREEN = """<html><head><title>none</title></head><body>
<script>addEventListener("message", event => { document.title = event.data; });</script>
<iframe src="page.html" style="width: {width}px; height: 800px"></iframe></body></html>"""

pytestmark = [
    pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed"),
    pytest.mark.slow,
    pytest.mark.timeout(3 * PATIENCE),
]


def seen(page, folder, width):
    """What a browser of a screen so wide found in a page."""
    watched = page.replace("<head>", f"<head>{WATCHES}", 1).replace("</body>", f"{TELLS}</body>", 1)
    (folder / "page.html").write_text(watched)
    (folder / "screen.html").write_text(SCREEN.replace("{width}", str(width)))
    flags = ("--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=20000", "--window-size=1300,900")
    command = [
        BROWSER,
        *flags,
        f"--user-data-dir={folder / 'profile'}",
        "--dump-dom",
        (folder / "screen.html").as_uri(),
    ]
    printed = subprocess.run(command, capture_output=True, text=True, check=True, timeout=2 * PATIENCE).stdout
    return json.loads(re.search("<title>(.*?)</title>", printed, re.DOTALL)[1])


@pytest.fixture(params=["report", "comparison", "scoreboard"])
def page(request, tmp_path):
    if request.param == "report":
        return render_report(RunFolder(SAMPLE))
    if request.param == "scoreboard":
        write_comparison([compared_steps(), compared_steps("2D_RPF_3200", ended="diverged")], tmp_path / "scores.html")
        return (tmp_path / "scores.html").read_text()
    shutil.copytree(SAMPLE, tmp_path / "copy")
    write_comparison(compared_runs([RunFolder(SAMPLE), RunFolder(tmp_path / "copy")]), tmp_path / "compared.html")
    return (tmp_path / "compared.html").read_text()


@pytest.mark.parametrize("width", [400, 1200])
def test_a_page_has_no_errors_and_fits_the_screen(page, width, tmp_path):
    found = seen(page, tmp_path, width)
    assert found["problems"] == []
    assert found["page"] <= found["screen"] <= width


def test_a_page_that_is_too_wide_or_has_an_error_is_found(tmp_path):
    wide = "<html><head></head><body><div style='width: 900px'>wide</div><script>none()</script></body></html>"
    found = seen(wide, tmp_path, 400)
    assert found["page"] > found["screen"]
    assert "none is not defined" in found["problems"][0]
