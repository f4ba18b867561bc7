"""The chart and the table of relaxations show all that was tried, the front and the choice."""

import numpy as np
import pytest
from matplotlib.colors import to_rgba
from summaries import relaxations

from cconv.report.colors import MARKED
from cconv.report.relaxation_plots import relaxations_chart, relaxations_table

RELAXED = relaxations("a")
TRIED = RELAXED.models["a"].tried


def test_every_relaxation_is_a_point_and_those_that_diverged_are_crosses():
    axes = relaxations_chart(RELAXED).axes[0]
    held, diverged = axes.collections[:2]
    assert held.get_offsets()[:, 1].tolist() == [each.quality for each in TRIED[1:] if not each.diverged]
    assert diverged.get_offsets()[:, 1].tolist() == [each.quality for each in TRIED[1:] if each.diverged]
    assert np.abs(held.get_offsets()[:, 0] - [1, 5, 3]).max() < 0.5


@pytest.mark.parametrize(("checkpoint", "number"), [("relaxed", 3), (None, 0)])
def test_the_choice_has_a_ring(checkpoint, number):
    axes = relaxations_chart(relaxations("a", checkpoint)).axes[0]
    (ring,) = [
        line for line in axes.get_lines() if to_rgba(line.get_markeredgecolor()) == to_rgba(MARKED["recommended"])
    ]
    assert ring.get_ydata()[0] == TRIED[number].quality


def test_the_table_is_the_front_with_none_and_the_choice():
    table = relaxations_table(RELAXED.models["a"], 3)
    assert table["relaxation"].tolist() == ["none", "1 loop", "3 loops", "5 loops"]
    assert table[""].tolist() == ["", "", "chosen", ""]
    assert relaxations_table(RELAXED.models["a"], 0)[""].tolist() == ["chosen", "", "", ""]
