"""Charts of importance show every hyperparameter, its interval, what could have been found, and each raw trial."""

import pytest
from summaries import changed, dependence, importance, judged, unvaried

from cconv.report.importance_plots import importance_chart, partial_dependence_chart


def entry(updates, censored):
    parameters = {"small": judged(0.02, decided=False), "constant": unvaried(), "large": judged(0.6, decided=True)}
    return importance(updates, parameters, censored)


def test_a_panel_a_rung_for_what_was_tested_and_what_was_estimated_with_the_largest_on_top():
    unknown = changed(entry(50, False), why_none="too few", parameters={})
    figure = importance_chart([unknown, entry(100, False), entry(300, True)])
    assert len(figure.axes) == 4
    first, last = figure.axes[0], figure.axes[2]
    assert [label.get_text() for label in first.get_yticklabels()] == ["large", "small", "constant"]
    assert first.yaxis_inverted()
    assert [bar.get_width() for bar in first.patches] == [0.6, 0.02]
    assert first.patches[0].get_facecolor() != first.patches[1].get_facecolor()
    assert "not stopped" in last.get_ylabel()
    assert "not stopped" not in first.get_ylabel()


def test_only_tested_shares_have_intervals_and_the_line_is_the_detectable_share():
    tested, estimated = importance_chart([entry(100, False)]).axes
    segments = [segment[:, 0].tolist() for segment in tested.collections[0].get_segments()]
    assert segments == [pytest.approx([0.45, 0.75]), pytest.approx([0.0, 0.025])]
    assert list(tested.lines[0].get_xdata()) == [0.62, 0.62]
    assert [list(line.get_xdata()) for line in estimated.lines] == [
        pytest.approx([0.2, 0.02 / 3, 0]),
        pytest.approx([0.15, 0.005, 0]),
    ]
    assert not estimated.collections


@pytest.mark.parametrize("first", ["choice", "linear", "log"])
def test_partial_dependence_shows_the_raw_trials(first):
    panels = {"choice": ["ball_to_cube_radial", "identity"], "linear": [1.0, 2.0], "log": [1e-3, 1e-2]}
    scales = [first, *(scale for scale in panels if scale != first), "log"]
    figure = partial_dependence_chart([dependence(scale, panels[scale]) for scale in scales])
    assert len(figure.axes) == 4
    for axes, scale in zip(figure.axes, scales, strict=True):
        assert list(axes.lines[0].get_ydata()) == [0.2, 0.7]
        assert "middle 80 % of its trees" in axes.get_legend_handles_labels()[1]
        assert axes.get_xscale() == ("log" if scale == "log" else "linear")
