"""Charts show what the tables hold, and labels do not cover each other."""

import itertools
import re

import numpy as np
import pytest
from matplotlib.text import Text
from summaries import SAMPLE, changed, explanation, solver_comparison, whole_summary

from cconv.report.fields import error_distribution_chart, fields_chart, filters_chart, read_explanations
from cconv.report.interactive import interactive_chart, interactive_html
from cconv.report.plots import (
    ablation_chart,
    best_so_far_chart,
    budget_chart,
    cost_chart,
    growth_chart,
    learning_curves_chart,
    rung_audit_chart,
    stability_chart,
    strategies_chart,
)
from cconv.report.speed_accuracy import error_range, speed_accuracy_chart, spread
from cconv.report.tables import ANALYTIC, curves_table, speed_accuracy_table, trials_table
from cconv.study.records.run_folder import RunFolder


@pytest.fixture
def run():
    return RunFolder(SAMPLE)


@pytest.fixture
def summary():
    return whole_summary(RunFolder(SAMPLE).summary())


def crowded(summary, count):
    """The summary with `count` finalists of nearly the same error and time."""
    copies = [changed(summary.finalists[0], id=f"copy_{number}", num_parameters=number) for number in range(count)]
    return changed(summary, finalists=[*summary.finalists, *copies])


def test_static_chart_has_log_axes_every_finalist_and_the_front(summary):
    (axes,) = speed_accuracy_chart(summary).axes
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    labels = " ".join(text.get_text() for text in axes.texts)
    assert all(entry.id in labels for entry in summary.finalists)
    assert {"front by validation", "predicting the mean: 1.58", "random", "second_look"} <= set(
        axes.get_legend_handles_labels()[1]
    )
    assert ANALYTIC in labels


@pytest.mark.parametrize("copies", [0, 12])
def test_names_in_the_static_chart_do_not_overlap(summary, copies):
    figure = speed_accuracy_chart(crowded(summary, copies))
    figure.draw_without_rendering()
    names = [text for text in figure.axes[0].texts if "parameters" in text.get_text()]
    assert len(names) == len(summary.finalists) + copies
    boxes = [Text.get_window_extent(text) for text in names]  # without the lines to the points
    assert not any(one.overlaps(other) for one, other in itertools.combinations(boxes, 2))


def test_heights_keep_order_gap_and_range():
    for wanted in ([0.5] * 5, [1.4, 0.9, 0.89, 0.1], [0.1, 0.05, 0.0], []):
        heights = spread(wanted, gap=0.1)
        assert all(high - low >= 0.1 - 1e-12 for high, low in itertools.pairwise(heights))
        assert all(0 <= height <= 1 for height in heights)
    assert spread([0.9, 0.5, 0.2], gap=0.1) == [0.9, 0.5, 0.2]


def test_the_error_axis_shows_all_finalists_and_not_what_diverged(summary):
    far = changed(summary.search_points[0], valid_error=1e9)
    points = speed_accuracy_table(changed(summary, search_points=[*summary.search_points, far]))
    low, high = error_range(points, 1.58)
    finalists = points[points["kind"] == "finalist"]
    assert low < finalists["error_low"].min()
    assert max(finalists["error_high"].max(), 1.58) < high < 100
    assert error_range(points, 50.0)[1] > 50


def test_interactive_chart_shows_every_point_with_its_hyperparameters(summary):
    figure = interactive_chart(summary)
    texts = [text for trace in figure.data for text in (trace.hovertext or ())]
    points = speed_accuracy_table(summary)
    assert len(texts) == len(points)
    for name, count in points["name"].value_counts().items():  # a finalist bears the name of the trial that found it
        assert sum(f"<b>{name}</b>" in text for text in texts) == count
    parameters = {point.id: point.parameters for point in summary.search_points}
    parameters |= {entry.id: entry.config.parameters for entry in summary.finalists}
    for text in texts:
        name = re.match("<b>(.*?)</b>", text)[1]
        assert "ms per frame" in text
        assert name == ANALYTIC or ("parameters" in text and all(f"{each} = " in text for each in parameters[name]))
    assert (figure.layout.xaxis.type, figure.layout.yaxis.type) == ("log", "log")


def test_stopped_trials_are_hollow_and_finalists_have_intervals(summary):
    traces = {trace.name: trace for trace in interactive_chart(summary).data}
    outcomes = [point.outcome for point in summary.search_points if point.stage == "random"]
    assert [symbol == "circle" for symbol in traces["random (search)"].marker.symbol] == [
        outcome == "completed" for outcome in outcomes
    ]
    chosen = traces["recommended"]
    assert chosen.marker.symbol == "star"
    low, high = summary.chosen.test.ci95
    assert chosen.y[0] + chosen.error_y.array[0] == pytest.approx(high)
    assert chosen.y[0] - chosen.error_y.arrayminus[0] == pytest.approx(low)


def test_a_finalist_without_an_interval_has_no_vertical_bars(summary):
    without = changed(summary.chosen, test=changed(summary.chosen.test, ci95=None))
    others = [entry for entry in summary.finalists if entry.id != summary.chosen.id]
    summary = changed(summary, finalists=[without, *others])
    chosen = {trace.name: trace for trace in interactive_chart(summary).data}["recommended"]
    assert np.isnan(chosen.error_y.array).all()
    assert "95 %" not in chosen.hovertext[0]
    bars = [len(container.lines[2]) for container in speed_accuracy_chart(summary).axes[0].containers]
    assert sorted(bars) == [1, *[2] * (len(summary.finalists) - 1)]


def lines_at(axes, value, get):
    """Lines of axes that lie at one value in one direction."""
    return [line for line in axes.lines if set(getattr(line, get)()) == {value}]


def test_every_chart_of_errors_shows_the_mean_predictors_own(run, summary):
    """That of the split that the chart shows: 4.5 on the validation split, 1.58 on the test split."""
    (tested,) = speed_accuracy_chart(summary).axes
    assert len(lines_at(tested, 1.58, "get_ydata")) == 1
    drawn = {trace.name: trace for trace in interactive_chart(summary).data}["predicting the mean: 1.58"]
    assert set(drawn.y) == {1.58}
    validated = [
        *learning_curves_chart(curves_table(run), summary).axes,
        *best_so_far_chart(trials_table(run), summary).axes,
        *strategies_chart(summary).axes,
    ]
    assert [len(lines_at(axes, 4.5, "get_ydata")) for axes in validated] == [1, 1, 1, 1]
    assert len(lines_at(ablation_chart(summary).axes[0], 4.5, "get_xdata")) == 1


def test_interactive_html_holds_its_program_once(summary):
    html = interactive_html(summary)
    assert html.count("* plotly.js v") == 1
    assert "cdn.plot.ly" not in html.split("</script>")[-1]


def test_charts_of_the_search_show_the_trials(run):
    search, finals = learning_curves_chart(curves_table(run)).axes
    stages = {record.stage for record in run.trials()}
    assert len(search.lines) == len(run.trials()) + len(stages)  # and a line of each stage for the legend
    assert len(finals.lines) == sum(len(records) for records in run.retrainings().values())
    assert best_so_far_chart(trials_table(run)).axes[0].get_yscale() == "log"


def test_the_chart_of_budgets_has_a_line_for_each_seed_of_each_finalist(run, summary):
    ids = [entry.id for entry in summary.finalists]
    updates, seconds = budget_chart(
        curves_table(run), [entry.id for entry in summary.finalists], summary.task.error
    ).axes
    trained = sum(len(records) for name, records in run.retrainings().items() if name in ids)
    assert len(updates.lines) == len(seconds.lines) == trained
    assert [text.get_text() for text in seconds.get_legend().get_texts()] == sorted(ids)


def test_other_charts_show_their_records(summary):
    assert len(growth_chart(summary).axes[0].lines) == len(summary.finalists)
    assert len(strategies_chart(summary).axes[0].lines) == 2 + 1  # that of the mean predictor
    assert [axes.get_title() for axes in rung_audit_chart(summary).axes] == [
        "rank correlation",
        "recall of the best",
        "regret",
    ]
    assert [len(axes.collections) for axes in rung_audit_chart(summary).axes] == [1, 0, 0]  # intervals of one measure
    labels = [label.get_text() for label in ablation_chart(summary).axes[0].get_yticklabels()]
    assert labels == ["baseline", "lost", "network.layers"]


def test_cost_chart_adds_geometry_and_network_fastest_first(summary):
    (axes,) = cost_chart(summary).axes
    times = [entry.cost.geometry_ms + entry.cost.network_ms for entry in summary.finalists]
    geometry, network = axes.containers
    ends = [bar.get_x() + bar.get_width() for bar in network]
    assert ends == pytest.approx(sorted(times), rel=1e-6)
    assert [bar.get_width() for bar in geometry] == pytest.approx([bar.get_x() for bar in network])


def test_points_right_of_the_line_are_the_checks_that_failed(summary):
    (axes,) = stability_chart(summary).axes
    *finalists, limit = axes.lines
    assert set(limit.get_xdata()) == {1}
    failed = [bool((line.get_xdata() > 1).any()) for line in finalists]
    assert failed == [not entry.stability.stable for entry in summary.finalists]


@pytest.mark.parametrize(("dim", "components"), [(1, 1), (2, 1), (2, 2), (3, 1), (3, 3)])
def test_what_was_learned_is_drawn_in_all_dimensions(dim, components):
    arrays = explanation(dim, components)
    assert len(filters_chart(arrays).axes) == dim + 1
    titles = [axes.get_title() for axes in fields_chart(arrays, "q").axes]
    symbol = "q" if components == 1 else "|q|"
    assert titles[:2] == [f"analytic {symbol}", f"predicted {symbol}"]


def test_space_is_drawn_as_a_slice_of_two_spacings():
    arrays = explanation(3, particles=500)
    drawn = fields_chart(arrays, "q").axes[0].collections[0].get_offsets()
    depth = arrays["positions"][:, 2]
    assert len(drawn) == (abs(depth - np.median(depth)) <= 0.1).sum() < 500


def test_error_distribution_has_the_models_that_were_explained():
    arrays = {"baseline": explanation()}
    (axes,) = error_distribution_chart(arrays, "baseline", "best").axes
    assert axes.get_legend_handles_labels()[1] == ["baseline"]
    heights = [patch.get_data().values for patch in axes.patches]
    assert all(each.sum() == pytest.approx(1) for each in heights)


def test_explanations_are_read_by_name_and_never_unpickled(tmp_path):
    run = RunFolder(tmp_path)
    (tmp_path / "explanation").mkdir()
    np.savez(tmp_path / "explanation" / "best.npz", **explanation())
    assert float(read_explanations(run, ["best"])["best"]["cutoff"]) == 0.2
    np.savez(tmp_path / "explanation" / "evil.npz", harm=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="allow_pickle"):
        read_explanations(run, ["evil"])


def beside_the_solver(summary, folder="2D_TGV_2500_10kevery100", horizon=20):
    """A study of a step on data of a name, with two solvers."""
    return changed(
        summary,
        solver=solver_comparison(1e-6, 2e-4, slow=[3e-6]),
        task=changed(summary.task, horizon=horizon),
        dataset=changed(summary.dataset, path=f"data/{folder}"),
    )


def test_solvers_are_points_with_names_in_both_charts(summary):
    summary = beside_the_solver(summary)
    names = {"SPH solver", "SPH solver, 2 times coarser", "SPH solver, slow sound"}
    static, interactive = speed_accuracy_chart(summary), interactive_chart(summary)
    (axes,) = static.axes
    assert names <= {text.get_text() for text in axes.texts}
    trace, slow = (trace for trace in interactive.data if str(trace.name).startswith("SPH solver"))
    assert (list(trace.x), list(trace.y)) == ([8, 2], [1e-6, 2e-4])
    assert (list(slow.x), list(slow.y)) == ([8], [3e-6])
    assert names == {re.match("<b>(.*?)</b>", text)[1] for text in (*trace.hovertext, *slow.hovertext)}
    assert axes.get_ylim()[0] < 1e-6


@pytest.mark.parametrize(
    ("folder", "horizon", "lines"),
    [("2D_TGV_2500", 20, 2), ("2D_TGV_2500", 5, 0), ("taylor_green_2d", 20, 0), ("2D_TGV_2500", None, 0)],
)
def test_published_errors_are_lines_on_lagrangebenchs_data_and_rollouts_of_its_length_alone(
    folder, horizon, lines, summary
):
    given = beside_the_solver(summary, folder, horizon)
    labels = speed_accuracy_chart(given).axes[0].get_legend_handles_labels()[1]
    for found in (labels, [trace.name for trace in interactive_chart(given).data]):
        assert sum("published" in name for name in found if name) == lines
