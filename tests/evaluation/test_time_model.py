import numpy as np
import pytest

from cconv.errors import ConfigError
from cconv.evaluation.time_model import TimeModel, check_cost_model
from cconv.networks.counting import CountedCost

TRUE = TimeModel(us_per_particle=0.5, us_per_flop=2e-5, us_per_byte=3e-4)


def estimates(count=12, seed=0):
    draws = np.exp(np.random.default_rng(seed).uniform(np.log(1e3), np.log(1e6), (count, 2)))
    return {
        f"model {place}": CountedCost(flops_per_particle=flops, bytes_per_particle=0.3 * moved)
        for place, (flops, moved) in enumerate(draws)
    }


def test_coefficients_of_exact_times_are_found():
    counted = list(estimates().values())
    fitted = TimeModel.fit(counted, [TRUE.predict(each) for each in counted])
    assert vars(fitted) == pytest.approx(vars(TRUE), rel=1e-6)


def test_coefficients_are_not_negative():
    counted = list(estimates().values())
    fitted = TimeModel.fit(counted, [1.0 + 1e6 / each.bytes_per_particle for each in counted])
    assert min(vars(fitted).values()) >= 0


def test_exact_times_are_predicted_exactly_and_noisy_ones_within_their_noise():
    counted = estimates()
    exact = {name: TRUE.predict(each) for name, each in counted.items()}
    check = check_cost_model(counted, exact)
    assert check.median_relative_error < 1e-6
    assert check.rank_correlation == pytest.approx(1)
    noise = np.random.default_rng(1).normal(0, 0.1, len(exact))
    noisy = check_cost_model(
        counted, {name: time * np.exp(e) for (name, time), e in zip(exact.items(), noise, strict=True)}
    )
    assert 0.02 < noisy.median_relative_error < 0.3
    assert noisy.relative_errors.keys() == noisy.predicted.keys() == exact.keys()


def test_a_model_is_predicted_from_the_others():
    """A time out of line is not fitted: the error is that of the true coefficients."""
    counted = estimates()
    measured = {name: TRUE.predict(each) for name, each in counted.items()}
    measured["model 3"] *= 4
    assert check_cost_model(counted, measured).relative_errors["model 3"] == pytest.approx(-0.75, abs=1e-6)


def test_too_few_or_other_models_are_refused():
    counted = estimates(4)
    with pytest.raises(ConfigError, match="at least 5"):
        check_cost_model(counted, dict.fromkeys(counted, 1.0))
    counted = estimates(6)
    with pytest.raises(ConfigError, match="the same models"):
        check_cost_model(counted, dict.fromkeys([*counted, "other"], 1.0))
