import pytest

from cconv.data.splits import share_out, split_by_trajectory, split_in_time

FRACTIONS = (0.7, 0.15, 0.15)


@pytest.mark.parametrize("total", range(3, 60))
def test_shares_sum_to_the_total_and_none_is_empty(total):
    for fractions in (FRACTIONS, (0.01, 0.01, 0.98), (1 / 3, 1 / 3, 1 / 3)):
        counts = share_out(total, fractions)
        assert sum(counts) == total
        assert min(counts) >= 1


def test_shares_are_near_the_fractions():
    assert share_out(100, FRACTIONS) == [70, 15, 15]


@pytest.mark.parametrize("count", [3, 4, 10, 37])
@pytest.mark.parametrize("seed", [0, 1])
def test_trajectories_stand_in_exactly_one_split(count, seed):
    names = [f"{index:03d}" for index in range(count)]
    splits = [[block.trajectory for block in blocks] for blocks in split_by_trajectory(names, FRACTIONS, seed)]
    assert sorted(name for split in splits for name in split) == names


def test_seed_decides_which_trajectories_go_where():
    names = [f"{index:03d}" for index in range(20)]
    assert split_by_trajectory(names, FRACTIONS, 0) == split_by_trajectory(names, FRACTIONS, 0)
    assert split_by_trajectory(names, FRACTIONS, 0) != split_by_trajectory(names, FRACTIONS, 1)


@pytest.mark.parametrize("gap", [0, 2, 5])
@pytest.mark.parametrize("num_frames", [13, 14, 79, 400])
def test_blocks_of_time_do_not_overlap_and_keep_the_gap(num_frames, gap):
    blocks = [block for (block,) in split_in_time("a", num_frames, FRACTIONS, gap)]
    assert blocks[0].start == 0
    assert blocks[-1].stop == num_frames
    assert all(block.start < block.stop for block in blocks)
    assert [later.start - earlier.stop for earlier, later in zip(blocks[:-1], blocks[1:], strict=True)] == [gap, gap]
