"""Particles of several windows one after another: whose each is, and which windows are joined."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cconv.batching import counts_of, groups_of, index_of, largest_of_windows, means_of_windows
from cconv.errors import ShapeError
from cconv.neighbors import radius_graph

COUNTS = [3, 0, 5, 1]


def test_an_index_counts_the_particles_that_it_was_made_of():
    assert index_of(COUNTS).tolist() == [0, 0, 0, 2, 2, 2, 2, 2, 3]
    assert counts_of(index_of(COUNTS)) == COUNTS
    assert counts_of(index_of([2, 0]), 2) == [2, 0]


def test_means_and_maxima_are_those_of_each_window(generator):
    values, index = torch.rand(9, 2, generator=generator, dtype=torch.float64), index_of(COUNTS)
    means, largest = means_of_windows(values, index), largest_of_windows(values[:, 0], index, 4)
    for window, (part, mean) in enumerate(zip(values.split(COUNTS), means.split(COUNTS), strict=True)):
        torch.testing.assert_close(mean, part.mean(dim=0).expand_as(part))
        assert largest[window] == (float(part[:, 0].max()) if len(part) else 0)
    torch.testing.assert_close(means_of_windows(values, None), values.mean(dim=0))


@given(st.lists(st.tuples(st.integers(1, 8), st.sampled_from("ab")), max_size=20), st.integers(1, 12))
def test_groups_hold_every_window_once_with_its_like_and_no_more_particles_than_allowed(windows, most):
    groups = groups_of([count for count, _ in windows], [kind for _, kind in windows], most)
    assert sorted(number for group in groups for number in group) == list(range(len(windows)))
    for group in groups:
        assert len({windows[number][1] for number in group}) == 1
        assert len(group) == 1 or sum(windows[number][0] for number in group) <= most


def test_alike_windows_are_joined_as_long_as_they_fit():
    assert groups_of([4, 4, 4, 9], ["a"] * 4, most=8) == [[0, 1], [2], [3]]
    assert groups_of([4, 4, 4], ["a", "b", "a"], most=8) == [[0, 2], [1]]


@pytest.mark.parametrize(
    "index", [torch.tensor([0, 1]), torch.tensor([1, 0, 1]), torch.tensor([0.0, 0.0, 1.0]), torch.tensor([-1, 0, 0])]
)
def test_an_index_that_is_none_is_refused(index):
    with pytest.raises(ShapeError, match="`batch_index` must"):
        radius_graph(torch.zeros(3, 2), 1.0, batch_index=index)
