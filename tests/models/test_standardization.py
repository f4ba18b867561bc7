import pytest
import torch

from cconv.models.standardization import standardize_features, standardize_values
from cconv.tasks.inputs import Features


def features(scalars, vectors):
    return Features(scalars=scalars, vectors=vectors, scalar_names=("one", "density"), vector_names=("velocity",))


def test_standardised_features_keep_the_constant_and_directions(generator):
    density = 5 * torch.randn(1000, 1, generator=generator) + 9
    scalars = torch.cat([torch.ones(1000, 1), density], dim=1)
    vectors = torch.randn(1000, 1, 2, generator=generator) * torch.tensor([3.0, 0.1]) + torch.tensor([2.0, 0])
    whole = features(scalars, vectors)
    halves = [features(scalars[part], vectors[part]) for part in (slice(500), slice(500, None))]
    standardization = standardize_features(halves)
    standardised = (whole.flat() - standardization.mean) / standardization.scale
    assert torch.equal(standardised[:, 0], torch.ones(1000, dtype=torch.float64))
    assert standardization.scale[2] == standardization.scale[3]
    torch.testing.assert_close(standardised[:, 1:].mean(0), torch.zeros(3, dtype=torch.float64), atol=1e-6, rtol=0)
    assert standardised[:, 1].std().item() == pytest.approx(1, rel=1e-2)


def test_vectors_that_must_turn_keep_their_mean(generator):
    whole = features(torch.ones(50, 2), torch.randn(50, 1, 2, generator=generator) + 4)
    assert torch.equal(standardize_features([whole], center_vectors=False).mean[2:], torch.zeros(2).double())


def test_mean_squared_error_of_standardised_vectors_is_normalised_by_the_variance(generator):
    target = torch.randn(200, 3, generator=generator, dtype=torch.float64) * torch.tensor([1.0, 2, 5])
    scale = standardize_values([target]).scale
    variance = target.var(dim=0, correction=0).mean()
    error = torch.full_like(target, 0.3)
    torch.testing.assert_close((error / scale).square().mean(), error.square().mean() / variance)


def test_a_constant_field_keeps_scale_one():
    standardization = standardize_values([torch.full((10, 2), 4.0)])
    assert torch.equal(standardization.scale, torch.ones(2, dtype=torch.float64))
