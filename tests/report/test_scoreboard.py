"""The scoreboard: a row is what its finalist measured, and what others report stands beside it for their data alone."""

import math
from dataclasses import replace
from statistics import fmean

import numpy as np
import pytest
from summaries import changed
from summaries import compared_steps as steps

from cconv.report.compared_runs import ComparedRun, Inputs
from cconv.report.comparison import write_comparison
from cconv.report.published import published_errors, published_table
from cconv.report.scoreboard import OURS, matrix, scores_table
from cconv.report.scoreboard_plots import scoreboard_chart
from cconv.report.tables import has_upper_end


def test_rows_are_the_finalists_by_error_then_what_they_are_measured_by():
    scores = scores_table([steps()])
    ours = scores[scores["source"] == OURS]
    assert ours["error"].tolist() == [1e-6, 3e-6, 1e-8, ours["error"].iloc[-1]]
    assert ours["network"].tolist()[2:] == ["SPH solver", "predicting the mean"]
    best, large = ours.head(2).to_dict("records")
    assert (large["to_best"], large["mse5"]) == (pytest.approx(3), pytest.approx(3e-6 / 9))
    assert (large["cpu_minutes"], large["hours"]) == (1.5, pytest.approx(3 / 3600))
    assert math.isnan(best["cpu_minutes"])
    assert math.isnan(large["ci95_low"])  # of a single training


def test_intervals_are_those_over_trainings():
    trained = {
        "large": [2e-6, 3e-6, 3e-6, 4e-6],
        "equal": [3e-6] * 4,
        "one": [3e-6],
        "blown_up": [1e-6, 1e-2, 1e-5, 0.2],
    }
    run = steps()
    first, *others = run.summary.finalists
    models = [
        changed(
            first,
            id=name,
            test=changed(first.test, error=fmean(errors), by_seed=dict(zip("abcd", errors, strict=False))),
        )
        for name, errors in trained.items()
    ]
    scores = scores_table([replace(run, summary=changed(run.summary, finalists=[*models, *others]))])
    known = scores.set_index("model")[["ci95_low", "error", "ci95_high"]]
    assert 2e-6 < known.loc["large", "ci95_low"] < 3e-6 < known.loc["large", "ci95_high"] < 9e-6
    assert known.loc["equal"].tolist() == pytest.approx([3e-6] * 3)
    assert known.loc["one"].isna().tolist() == [True, False, True]
    assert not has_upper_end(*known.loc["blown_up", ["ci95_low", "ci95_high"]])
    low, high = scoreboard_chart(scores).axes[0].get_ylim()
    assert low < 3e-6
    assert high < 1e3 * known["error"].max()  # although the upper end of an interval is far beyond


def test_the_chart_has_a_panel_for_each_data_set_and_one_look_for_each_network():
    folders = ["2D_TGV_2500_10kevery100", "2D_RPF_3200_20kevery100", "elsewhere"]
    figure = scoreboard_chart(scores_table([steps(folder) for folder in folders]))
    panels = [dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True)) for axes in figure.axes]
    assert [axes.get_title() for axes in figure.axes] == folders
    assert len({panel["large"].lines[0].get_color() for panel in panels}) == 1
    published = [panel.get("GNS-10-128, published") for panel in panels]
    assert [line is not None and line.get_ydata()[0] for line in published] == [5.9e-6, 4.0e-6, False]
    assert all("SPH solver" in panel for panel in panels)


def test_whole_rollouts_are_means_over_trainings_and_trajectories():
    (row,) = scores_table([steps()]).query("model == 'large'").to_dict("records")
    assert row["mse"] == pytest.approx(np.mean([1e-6 * (frame + 1) ** 2 for frame in range(12)]))
    assert row["e_kin"] == pytest.approx(np.mean([(0.1 * 0.9**look) ** 2 for look in range(4)]))
    assert row["frames"] == 12
    assert math.isnan(row["ended"])
    assert math.isnan(row["sinkhorn"])  # these records have none


def test_a_rollout_that_ends_early_has_no_error_but_its_frame():
    (row,) = scores_table([steps(ended="diverged")]).query("model == 'large'").to_dict("records")
    assert (row["ended"], row["frames"]) == (7, 12)
    assert math.isnan(row["mse"])


def test_published_rows_are_those_of_the_same_data():
    found, other = (scores_table([steps(folder)]) for folder in ("2D_TGV_2500_10kevery100", "elsewhere"))
    published = found[found["source"] != OURS]
    assert set(published["network"]) == {"GNS-5-64", "GNS-10-128", "SEGNN-5-64", "SEGNN-10-64"}
    assert published.query("source == 'checkpoints' and network == 'GNS-10-128'")["error"].tolist() == [5.9e-6]
    assert (other["source"] == OURS).all()
    assert published["updates"].isna().all()


def test_errors_of_rollouts_of_another_length_are_not_compared_with_published_ones():
    scores = scores_table([steps(horizon=10)])
    assert scores[scores["source"] != OURS]["error"].isna().all()
    assert published_errors(steps(horizon=10).summary) == {}
    assert published_errors(steps().summary) == {"GNS-10-128": 5.9e-6, "SEGNN-10-64": 4.4e-6}


def test_published_figures_are_positive_and_given_once():
    table = published_table()
    numbers = table.drop(columns=["data", "network", "source"])
    assert ((numbers > 0) | numbers.isna()).all(axis=None)
    assert not table.duplicated(["data", "network", "source"]).any()
    assert (table[["mse20", "mse"]].notna().any(axis=1)).all()


def test_networks_of_several_scenes_are_beside_each_other():
    scores = scores_table([steps(), steps("2D_RPF_3200_20kevery100")])
    wide = matrix(scores).set_index("network")
    assert list(wide.columns) == ["2D_TGV_2500_10kevery100", "2D_RPF_3200_20kevery100"]
    assert wide.loc["GNS-5-64, published"].tolist() == [9.6e-6, 9.8e-6]
    assert matrix(scores_table([steps()])).empty


def test_fields_have_no_scoreboard(tmp_path):
    run = steps()
    field = ComparedRun(
        label="f", summary=changed(run.summary, task=changed(run.summary.task, horizon=None)), inputs=Inputs()
    )
    assert scores_table([field]).empty
    write_comparison([field], tmp_path / "field.html")
    assert "Scoreboard" not in (tmp_path / "field.html").read_text()


def test_the_page_says_what_the_published_networks_were_trained_with(tmp_path):
    write_comparison([steps(), steps("2D_RPF_3200_20kevery100", ended="diverged")], tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "500,000 updates on an A6000" in page
    assert "ends at 7 of 12" in page
    assert ">nan<" not in page
    write_comparison([steps("elsewhere")], tmp_path / "own.html")
    assert "A6000" not in (tmp_path / "own.html").read_text()
