"""Every figure of a page has a title, labelled axes and a caption, and says in words what it shows."""

import re
import shutil

import pytest
from matplotlib.figure import Figure
from summaries import SAMPLE, compared_steps, whole_run_in

from cconv.report import page
from cconv.report.compared_runs import compared_runs
from cconv.report.comparison import write_comparison
from cconv.report.interactive import interactive_chart
from cconv.study.records.run_folder import RunFolder

FIGURE = re.compile(r"<figure>(.*?)</figure>", re.DOTALL)
CAPTION = re.compile(r"<figcaption>(.*?)</figcaption>", re.DOTALL)


@pytest.fixture
def drawn(monkeypatch):
    """The figures that a page draws, in their order."""
    figures: list[Figure] = []
    encode = page._png

    def kept(figure):
        figures.append(figure)
        return encode(figure)

    monkeypatch.setattr(page, "_png", kept)
    return figures


@pytest.fixture(params=["report", "comparison", "scoreboard"])
def shown(request, tmp_path, drawn):
    """A page with all kinds of figures, and the figures of matplotlib in it."""
    if request.param == "report":
        return page.render_report(whole_run_in(tmp_path)), drawn
    if request.param == "scoreboard":
        write_comparison([compared_steps()], tmp_path / "scoreboard.html")
        return (tmp_path / "scoreboard.html").read_text(), drawn
    run = RunFolder(shutil.copytree(SAMPLE, tmp_path / "run"))
    write_comparison(compared_runs([RunFolder(SAMPLE), run]), tmp_path / "compared.html")
    return (tmp_path / "compared.html").read_text(), drawn


def is_labelled(axes, name):
    """Whether an axis has a label, its own or that of the axes with which it shares its ticks."""
    shared = {"x": axes.get_shared_x_axes, "y": axes.get_shared_y_axes}[name]().get_siblings(axes)
    return any(getattr(each, f"get_{name}label")().strip() for each in shared)


def names_its_rows(axes):
    """Whether the ticks of the vertical axis are words, which need no label."""
    texts = [label.get_text() for label in axes.get_yticklabels()]
    return any(re.search("[a-z]{3}", text) for text in texts)


def lacks(figure):
    """What a figure lacks, in words."""
    found = []
    for axes in figure.axes:
        is_colorbar = hasattr(axes, "_colorbar")
        if not (axes.get_title() or figure.get_suptitle() or is_colorbar):
            found.append("title")
        if not is_labelled(axes, "x") and not is_colorbar:
            found.append(f"x label of {axes.get_title()!r}")
        if not is_labelled(axes, "y") and not names_its_rows(axes):
            found.append(f"y label of {axes.get_title()!r}")
    return found


def test_charts_have_titles_and_labelled_axes(shown):
    _, figures = shown
    assert figures
    assert [lacks(figure) for figure in figures] == [[] for _ in figures]


def test_every_picture_stands_in_a_figure_with_a_caption_and_words_in_its_place(shown):
    text, figures = shown
    framed = FIGURE.findall(text)
    captions = [CAPTION.findall(each) for each in framed]
    assert all(len(found) == 1 and len(found[0].split()) >= 10 for found in captions)
    assert text.count("<img") == sum(each.count("<img") for each in framed) >= len(figures)
    assert all(alt.strip() for alt in re.findall(r'<img alt="(.*?)"', text))
    assert text.count("<img alt=") == text.count("<img")


def test_the_interactive_chart_has_title_and_units():
    layout = interactive_chart(RunFolder(SAMPLE).summary()).layout
    assert layout.title.text
    assert "[ms]" in layout.xaxis.title.text
    assert layout.yaxis.title.text.startswith("error (")


def test_a_figure_that_lacks_something_is_found():
    figure = Figure()
    axes = figure.add_subplot()
    assert lacks(figure) == ["title", "x label of ''", "y label of ''"]
    axes.set(title="speed", xlabel="time [s]", ylabel="speed [m/s]")
    assert lacks(figure) == []
