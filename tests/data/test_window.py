"""Windows cut from trajectories."""

import pytest
import torch
from systems import periodic_trajectory

from cconv.data.window import Windows, window_at
from cconv.errors import DataError


def test_windows_follow_each_other_frame_by_frame(generator):
    trajectory = periodic_trajectory(generator, num_frames=7)
    cut = list(Windows([trajectory], history=3, future=2))
    assert [window.frame for window in cut] == [2, 3, 4]
    for window, later in zip(cut, cut[1:], strict=False):
        assert torch.equal(window.followed_by(window.future[0]).positions, later.positions)


def test_windows_of_lagrange_bench_do_not_overlap(generator):
    trajectory = periodic_trajectory(generator, num_frames=11)
    cut = list(Windows([trajectory], history=3, future=2, stride=5))
    frames = torch.cat([torch.cat([window.positions, window.future]) for window in cut])
    assert torch.equal(frames, trajectory.positions[: len(frames)])
    assert len(cut) == 2


def test_the_frame_counts_from_the_start_of_the_stored_trajectory(generator):
    trajectory = periodic_trajectory(generator, num_frames=4)
    moved = type(trajectory)(**{**vars(trajectory), "first_frame": 10})
    assert window_at(moved, 2, history=2, future=1).frame == 12


@pytest.mark.parametrize(
    ("present", "history", "future"), [(1, 3, 1), (3, 2, 1), (9, 1, 0)], ids=["no past", "no future", "no frame"]
)
def test_a_window_beyond_the_trajectory_is_refused(present, history, future, generator):
    with pytest.raises(DataError, match="ask for fewer or another start"):
        window_at(periodic_trajectory(generator, num_frames=4), present, history, future)


def test_a_trajectory_that_is_too_short_is_refused_before_the_first_window(generator):
    with pytest.raises(DataError, match="4 frames, too few for a window of 6 and 1 after it"):
        Windows([periodic_trajectory(generator, num_frames=4)], 6, 1)
