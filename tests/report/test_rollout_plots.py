"""Charts of rollouts show what was recorded: medians and ranges, where a rollout ended, stored values beside."""

import numpy as np
import pytest
from matplotlib.colors import to_rgba
from summaries import rollouts

from cconv.report.colors import ANALYTIC_COLOR
from cconv.report.rollout_plots import beyond_table, distributions_chart, energy_chart, rollout_errors_chart
from cconv.study.records.rollouts import FinalistRollouts

RECORDED = {"a": rollouts(), "b": rollouts(ended="diverged: particles clumped")}


def by_label(axes):
    return {line.get_label(): line for line in axes.get_lines()}


def test_errors_are_medians_up_to_the_last_frame_that_any_rollout_reached():
    (axes,) = rollout_errors_chart(RECORDED).axes
    lines = by_label(axes)
    mse = np.array(RECORDED["b"].rolled[0].mse)
    assert np.allclose(lines["b"].get_ydata(), mse)
    assert lines["b"].get_xdata().tolist() == list(range(1, 13))
    crosses = [line for line in axes.get_lines() if line.get_marker() == "x"]
    assert [(line.get_xdata()[0], line.get_ydata()[0]) for line in crosses] == [(7, mse[6])]


def test_energies_of_each_trajectory_stand_beside_the_stored_one():
    panels = energy_chart(RECORDED).axes
    assert [axes.get_title() for axes in panels] == ["test/00000", "test/00001"]
    for axes in panels:
        stored = by_label(axes)["stored"]
        assert to_rgba(stored.get_color()) == to_rgba(ANALYTIC_COLOR)
        assert np.allclose(stored.get_ydata(), RECORDED["a"].rolled[0].reference.e_kin)
        assert len(axes.get_lines()) == 5  # two finalists with two trainings, and what is stored


def test_distributions_have_a_line_a_finalist_and_the_stored_one():
    for axes in distributions_chart(RECORDED).axes:
        lines = by_label(axes)
        assert set(lines) == {"a", "b", "stored"}
        assert lines["stored"].get_ydata().tolist() == [0.25, 0.5, 0.25, 0.0]


def test_the_table_says_what_was_reached_and_what_went_beyond_a_limit():
    table = beyond_table(RECORDED)
    last = table.iloc[-1]
    assert len(table) == 8
    assert (last["frames"], last["first frame beyond a limit"]) == ("7 of 12", "energy too high: 5")
    assert last["error over all frames"] == pytest.approx(np.mean(RECORDED["b"].rolled[-1].mse))
    assert table["first frame beyond a limit"][:7].tolist() == ["none"] * 7


def test_a_finalist_without_a_rollout_is_left_out():
    recorded = RECORDED | {"c": FinalistRollouts(rolled=(), lost=("seed_1, trajectory test/00000: diverged",))}
    assert set(by_label(rollout_errors_chart(recorded).axes[0])) >= {"a", "b"}
    assert "c" not in by_label(rollout_errors_chart(recorded).axes[0])
    assert beyond_table({}).empty
