"""Charts of importance show every hyperparameter, its interval, the floor of noise and each raw trial."""

import pytest

from cconv.report.importance_plots import importance_chart, partial_dependence_chart


def judged(importance, above):
    return {"importance": importance, "low": importance / 2, "high": importance * 1.5, "above_noise": above}


def entry(updates, censored):
    parameters = {"small": judged(0.02, False), "large": judged(0.6, True)}
    found = {"noise_floor": 0.1, "parameters": parameters}
    return {
        "updates": updates,
        "trials": 40,
        "censored": censored,
        "clipped": 0,
        "surrogate_r2": 0.5,
        "f_anova": found,
        "ped_anova": found,
    }


def dependence(scale, values):
    error = [0.1 * (position + 1) for position in range(len(values))]
    return {
        "parameter": f"of {scale}",
        "scale": scale,
        "updates": 1000,
        "trials": 3,
        "surrogate_r2": None if scale == "linear" else 0.5,
        "values": values,
        "error": error,
        "low": [each / 2 for each in error],
        "high": [each * 2 for each in error],
        "points": [{"value": values[0], "error": 0.2}, {"value": values[-1], "error": 0.7}],
    }


def test_a_panel_a_rung_and_method_with_the_most_important_on_top():
    figure = importance_chart([entry(100, False), entry(300, True)])
    assert len(figure.axes) == 4
    first, last = figure.axes[0], figure.axes[2]
    assert [label.get_text() for label in first.get_yticklabels()] == ["large", "small"]
    assert first.yaxis_inverted()
    assert [bar.get_width() for bar in first.patches] == [0.6, 0.02]
    assert first.patches[0].get_facecolor() != first.patches[1].get_facecolor()
    assert "not stopped" in last.get_ylabel()
    assert "not stopped" not in first.get_ylabel()


@pytest.mark.parametrize("first", ["choice", "linear", "log"])
def test_partial_dependence_shows_the_raw_trials(first):
    panels = {"choice": ["ball_to_cube_radial", "identity"], "linear": [1.0, 2.0], "log": [1e-3, 1e-2]}
    scales = [first, *(scale for scale in panels if scale != first), "log"]
    figure = partial_dependence_chart([dependence(scale, panels[scale]) for scale in scales])
    assert len(figure.axes) == 4
    for axes, scale in zip(figure.axes, scales, strict=True):
        assert list(axes.lines[0].get_ydata()) == [0.2, 0.7]
        assert axes.get_xscale() == ("log" if scale == "log" else "linear")
