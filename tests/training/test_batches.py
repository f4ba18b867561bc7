from itertools import islice

import pytest

from cconv.training.batches import batches, epoch_order


def test_order_depends_on_seed_and_epoch_alone():
    assert (epoch_order(20, 3, 5) == epoch_order(20, 3, 5)).all()
    assert (epoch_order(20, 3, 5) != epoch_order(20, 3, 6)).any()
    assert (epoch_order(20, 3, 5) != epoch_order(20, 4, 5)).any()


@pytest.mark.parametrize("batch_size", [1, 3, 7, 10])
def test_every_epoch_sees_every_sample_once(batch_size):
    stream = batches(7, batch_size, data_seed=0)
    for epoch in range(3):
        seen = []
        while len(seen) < 7:
            seen += next(stream)
        assert seen == epoch_order(7, 0, epoch).tolist()


def test_all_trials_see_the_same_batches_also_those_that_go_on_later():
    """The order of (5 samples, seed 1) as it was drawn once, so that a resumed training in another process has it."""
    known = [[4, 0], [1, 2], [3], [1, 4], [0, 3], [2]]
    assert list(islice(batches(5, 2, 1), 6)) == known
