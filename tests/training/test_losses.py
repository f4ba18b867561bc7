import math

import pytest
import torch

from cconv.errors import ConfigError
from cconv.training.losses import LOSSES, SQUARED, balanced, frame_weight


@pytest.fixture
def answers(generator):
    return torch.randn(50, 2, generator=generator), torch.randn(50, 2, generator=generator)


@pytest.mark.parametrize("name", SQUARED)
def test_losses_are_weighted_squares(name, answers):
    prediction, target = answers
    ratio = LOSSES[name](prediction, target, torch.arange(50)) / (prediction - target).square().mean()
    assert float(ratio) == pytest.approx(frame_weight(name)(target))


def test_a_balanced_frame_counts_the_more_the_calmer_it_is(generator):
    target = torch.randn(50, 2, generator=generator)
    weights = [balanced(share * target) for share in (1.0, 0.1, 0.01)]
    assert weights[1] == pytest.approx(10 * weights[0], rel=1e-4)
    assert weights[2] == pytest.approx(100 * weights[0], rel=1e-4)
    assert balanced(torch.zeros(5, 2)) == 1000  # a frame at rest has a weight too


def test_particles_with_few_neighbors_count_more_by_the_root_of_their_error(answers):
    """Equation 10 of the paper, particle by particle."""
    prediction, target = answers
    neighbors = torch.arange(50)
    expected = sum(
        math.exp(-count / 40) * math.dist(found, wanted) ** 0.5
        for found, wanted, count in zip(prediction.tolist(), target.tolist(), range(50), strict=True)
    )
    loss = LOSSES["neighbor_weighted"](prediction, target, neighbors)
    assert float(loss) == pytest.approx(expected / 50, rel=1e-5)


def test_an_answer_without_error_has_a_gradient(answers):
    target = answers[1]
    prediction = target.clone().requires_grad_()
    LOSSES["neighbor_weighted"](prediction, target, torch.ones(50)).backward()
    assert prediction.grad.abs().max() == 0


def test_a_loss_that_is_no_sum_of_squares_has_no_closed_form():
    with pytest.raises(ConfigError, match="training.loss"):
        frame_weight("neighbor_weighted")
