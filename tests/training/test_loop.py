import itertools
import math

import pytest
import torch
from systems import configured, problem

from cconv.errors import ConfigError
from cconv.models.errors import frame_errors, normalized_mse
from cconv.training.examples import StoredExamples
from cconv.training.loop import SCHEDULES, Optimization, train

LINEAR = configured(layers=1, kernel_size=4, relative_cutoff=2.0, message="difference", mapping="identity")


def run(given, network=LINEAR, seed=0, cache_bytes=2**30, **options):
    model = given.build_model(network, seed)
    asked = Optimization(**{"updates": 6, "evaluate_every": 3, "learning_rate": 0.05} | options)
    return model, list(
        train(model, StoredExamples(given.train_samples), given.valid_error, asked, cache_bytes=cache_bytes)
    )


def test_training_learns_the_density_rate(generator):
    _, states = run(problem(generator), updates=120, evaluate_every=60)
    assert states[-1].valid_error < 0.1 < states[0].train_loss


def test_reported_error_is_the_models(generator):
    given = problem(generator)
    model, states = run(given)
    assert states[-1].valid_error == pytest.approx(normalized_mse(frame_errors(model, given.valid_samples)))


def test_evaluations_come_when_due_and_at_the_end(generator):
    _, states = run(problem(generator), updates=7, evaluate_every=3)
    assert [state.updates for state in states] == list(range(1, 8))
    assert [state.updates for state in states if state.valid_error is not None] == [3, 6, 7]


def test_evaluations_take_nothing_of_the_time_and_the_last_update_is_evaluated(generator, monkeypatch):
    """Every look at the clock of the process takes a second: one an update, if no evaluation is counted."""
    monkeypatch.setattr("cconv.training.loop.time.process_time", itertools.count().__next__)
    _, states = run(problem(generator), updates=100, evaluate_every=2, cpu_seconds=4.5)
    assert [state.cpu_seconds for state in states] == [1, 2, 3, 4, 5]
    assert [state.updates for state in states if state.valid_error is not None] == [2, 4, 5]
    assert [state.share for state in states[:2]] == [1 / 4.5, 2 / 4.5]


def test_whichever_is_spent_first_ends_a_training(generator, monkeypatch):
    monkeypatch.setattr("cconv.training.loop.time.process_time", itertools.count().__next__)
    _, states = run(problem(generator), updates=3, cpu_seconds=1000.0)
    assert [state.updates for state in states] == [1, 2, 3]


def test_the_same_seeds_give_the_same_losses(generator):
    given = problem(generator)
    first, again = ([(state.train_loss, state.valid_error) for state in run(given, batch_size=2)[1]] for _ in range(2))
    assert first == again


def test_without_a_cache_the_result_is_the_same(generator):
    given = problem(generator)
    kept, rebuilt = (run(given, cache_bytes=size)[1][-1].train_loss for size in (2**30, 0))
    assert kept == rebuilt


def test_a_batch_is_the_mean_over_its_frames(generator):
    given = problem(generator)
    _, states = run(given, batch_size=4, updates=1)
    losses = [error.normalized_mse for error in frame_errors(given.build_model(LINEAR, 0), given.train_samples)]
    assert states[0].train_loss == pytest.approx(sum(losses) / 4, rel=1e-5)


def test_a_loss_that_is_not_finite_ends_training_and_leaves_the_weights(generator):
    given = problem(generator)
    model = given.build_model(LINEAR, 0)
    model.target_mean.fill_(math.nan)
    before = model.network.convs[0].filters.clone()
    states = list(
        train(model, StoredExamples(given.train_samples), given.valid_error, Optimization(updates=5, evaluate_every=1))
    )
    assert len(states) == 1
    assert states[0].diverged
    assert torch.equal(model.network.convs[0].filters, before)


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_schedules_start_at_the_full_rate_and_do_not_rise(schedule, generator):
    _, states = run(problem(generator), updates=10, schedule=schedule)
    rates = [state.learning_rate for state in states]
    assert rates[0] == pytest.approx(0.05)
    assert all(later <= earlier for earlier, later in zip(rates, rates[1:], strict=False))


def test_unknown_schedule_is_refused(generator):
    with pytest.raises(ConfigError, match="Did you mean 'cosine'"):
        run(problem(generator), schedule="cosin")
