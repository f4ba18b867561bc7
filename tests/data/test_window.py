"""Windows cut from trajectories."""

from dataclasses import replace

import pytest
import torch
from systems import periodic_frame, periodic_trajectory, window_of, with_walls

from cconv.batching import index_of
from cconv.data.window import Windows, join_windows, joinable, window_at, window_from_arrays
from cconv.errors import DataError, ShapeError


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


def test_a_single_frame_holds_no_step(generator):
    with pytest.raises(DataError, match="a single frame, and a step leads to the next one.*--separate-frames"):
        Windows([periodic_trajectory(generator, num_frames=1)], 6, 1)


def walled_windows(generator):
    """Windows of different trajectories, whose numbers of particles and wall points differ."""
    found = []
    for number, name in enumerate("abc"):
        window = window_of(with_walls(periodic_frame(generator, 5 + number)), generator, 3, 2)
        walls = {part: getattr(window.boundary, part)[number:] for part in ("positions", "normals")}
        boundary = replace(window.boundary, **walls)
        found.append(replace(window, trajectory=name, frame=10 * number, boundary=boundary))
    return found


def assert_same(ours, theirs):
    assert ours.origins == theirs.origins
    for name in ("positions", "future", "masses", "particle_types", "batch_index"):
        found, expected = getattr(ours, name), getattr(theirs, name)
        assert found is expected is None or torch.equal(found, expected)
    for name in ("positions", "normals"):
        assert torch.equal(getattr(ours.boundary, name), getattr(theirs.boundary, name))


def test_windows_that_are_joined_are_separated_again_also_a_frame_later(generator):
    windows = walled_windows(generator)
    joined = join_windows(windows)
    assert torch.equal(joined.batch_index, index_of([25, 36, 49]))
    assert torch.equal(joined.boundary.batch_index, index_of([8, 7, 6]))
    later = joined.followed_by(joined.future[0])
    for window, same, following in zip(windows, joined.separated(), later.separated(), strict=True):
        assert_same(same, window)
        assert_same(following, window.followed_by(window.future[0]))


def test_some_of_joined_windows_are_these_joined(generator):
    windows = walled_windows(generator)
    joined = join_windows(windows)
    assert_same(joined.only([True, False, True]), join_windows([windows[0], windows[2]]))
    assert_same(joined.only([False, True, False]), windows[1])
    assert joined.only([True] * 3) is joined
    assert join_windows(windows[:1]) is windows[0]


def test_windows_with_other_frames_or_walls_are_not_joined(generator):
    first, second, third = walled_windows(generator)
    assert joinable([first, second, third]) == [[0, 1, 2]]
    shorter = replace(second, future=second.future[:1])
    bare = replace(third, boundary=None)
    without_normals = replace(third, boundary=replace(third.boundary, normals=None))
    with_solids = replace(third, particle_types=torch.ones_like(third.particle_types))
    others = [shorter, bare, without_normals, with_solids, replace(first, positions=first.positions.double())]
    assert joinable([first, *others]) == [[number] for number in range(6)]


def test_arrays_of_another_program_are_the_window_that_the_data_set_gives(generator):
    trajectory = periodic_trajectory(generator, num_frames=4)
    stored = window_at(trajectory, present=3, history=3, future=0)
    given = window_from_arrays(trajectory.positions[1:].numpy(), trajectory.masses.numpy())
    for name in ("positions", "masses", "particle_types"):
        assert torch.equal(getattr(given, name), getattr(stored, name))
    assert given.is_fluid.all()


def test_arrays_that_do_not_fit_are_refused(generator):
    positions, masses = torch.rand(3, 5, 2, generator=generator), torch.ones(5)
    for wrong, word in (
        ((positions[0], masses), "frames, particles, dim"),
        ((positions, masses[1:]), "masses"),
        ((positions, masses, [0, 1]), "particle_types"),
        ((positions / 0 * 0, masses), "finite"),
    ):
        with pytest.raises(ShapeError, match=word):
            window_from_arrays(*wrong)
