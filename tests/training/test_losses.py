import pytest
import torch

from cconv.training.losses import LOSSES, loss_of


@pytest.mark.parametrize("name", LOSSES)
def test_losses_are_weighted_squares(name, generator):
    target, prediction = torch.randn(50, 2, generator=generator), torch.randn(50, 2, generator=generator)
    ratio = loss_of(prediction, target, LOSSES[name]) / (prediction - target).square().mean()
    assert float(ratio) == pytest.approx(LOSSES[name](target))


def test_a_balanced_frame_counts_the_more_the_calmer_it_is(generator):
    target = torch.randn(50, 2, generator=generator)
    weights = [LOSSES["balanced_mse"](share * target) for share in (1.0, 0.1, 0.01)]
    assert weights[1] == pytest.approx(10 * weights[0], rel=1e-4)
    assert weights[2] == pytest.approx(100 * weights[0], rel=1e-4)
    assert LOSSES["balanced_mse"](torch.zeros(5, 2)) == 1000  # a frame at rest has a weight too
