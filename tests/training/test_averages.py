"""Averages of weights follow the weights, and forget where these began."""

import pytest
import torch
from systems import configured, problem

from cconv.training.averages import begin_average, update_average


@pytest.fixture
def model(generator):
    return problem(generator).build_model(configured(layers=1, kernel_size=3), 0)


def set_weights(model, value):
    with torch.no_grad():
        for weights in model.parameters():
            weights.fill_(value)


def test_an_average_equals_the_weighted_mean_of_all_weights(model):
    decay, values = 0.5, [3.0, 1.0, 4.0, 1.0, 5.0]
    average = begin_average(model)
    set_weights(average, 0.0)
    for update, value in enumerate(values, start=1000):  # late, where the decay is the asked one
        set_weights(model, value)
        update_average(average, model, decay, update)
    expected = sum((1 - decay) * decay**age * value for age, value in enumerate(reversed(values)))
    assert all(torch.allclose(weights, torch.tensor(expected)) for weights in average.parameters())


def test_initial_weights_are_forgotten_early_even_by_slow_averages(model):
    set_weights(model, 1e3)
    average = begin_average(model)
    set_weights(model, 1.0)
    for update in range(1, 200):
        update_average(average, model, 0.9999, update)
    assert all(torch.allclose(weights, torch.tensor(1.0), atol=0.01) for weights in average.parameters())


def test_the_model_is_left_as_it_is(model):
    average, before = begin_average(model), [weights.clone() for weights in model.parameters()]
    set_weights(average, 7.0)
    update_average(average, model, 0.9, 5)
    assert all(torch.equal(*pair) for pair in zip(model.parameters(), before, strict=True))
    assert not any(weights.requires_grad for weights in average.parameters())
    assert all(weights.requires_grad for weights in model.parameters())
