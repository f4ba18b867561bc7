"""What the messages of a radial network guarantee whatever its weights: momentum, and Galilei's principle."""

import pytest
import torch
from pydantic import ValidationError

from cconv.batching import index_of
from cconv.errors import ConfigError
from cconv.neighbors import radius_graph
from cconv.networks import RadialNetSettings
from cconv.nn.kinds import Kinds

INPUTS, VECTOR = Kinds(2, 3), Kinds(0, 1)


def built(generator, **settings):
    settings = RadialNetSettings(first_channels=4, hidden_channels=3, radial_terms=5, activation="tanh", **settings)
    network = settings.build(INPUTS, None, VECTOR, 2, generator).double()
    features = torch.randn(60, INPUTS.num_values(2), generator=generator, dtype=torch.float64)
    positions = 5 * torch.rand(60, 2, generator=generator, dtype=torch.float64)
    geometry = settings.geometry(radius_graph(positions, settings.relative_cutoff))
    return lambda values: network(settings.arrange(values, INPUTS, 2), geometry), features


@pytest.mark.parametrize("layers", [1, 2, 4])
@pytest.mark.parametrize("message", ["absolute", "mixed", "opposite", "difference"])
def test_what_conserves_momentum_adds_up_to_nothing(layers, message, generator):
    predict, features = built(generator, layers=layers, message=message, conserves_momentum=True)
    predicted = predict(features)
    assert predicted.abs().max() > 1e-3
    assert predicted.sum(dim=0).abs().max() < 1e-12 * predicted.abs().sum()
    free, features = built(generator, layers=layers, message=message)
    assert free(features).sum(dim=0).abs().max() > 1e-3


@pytest.mark.parametrize("layers", [1, 3])
def test_momentum_is_conserved_in_each_of_several_windows(layers, generator):
    """What one window answers does not depend on the others."""
    settings = RadialNetSettings(layers=layers, message="mixed", conserves_momentum=True, first_channels=4)
    network, counts = settings.build(INPUTS, None, VECTOR, 2, generator).double(), [60, 35]
    features = torch.randn(95, INPUTS.num_values(2), generator=generator, dtype=torch.float64)
    positions = 5 * torch.rand(95, 2, generator=generator, dtype=torch.float64)
    cutoff = settings.relative_cutoff
    joined = network(features, settings.geometry(radius_graph(positions, cutoff, batch_index=index_of(counts))))
    parts = zip(features.split(counts), positions.split(counts), joined.split(counts), strict=True)
    for values, points, predicted in parts:
        assert predicted.sum(dim=0).abs().max() < 1e-12 * predicted.abs().sum()
        torch.testing.assert_close(predicted, network(values, settings.geometry(radius_graph(points, cutoff))))


@pytest.mark.parametrize("layers", [1, 3])
@pytest.mark.parametrize(("message", "knows"), [("mixed", False), ("opposite", False), ("absolute", True)])
def test_a_common_velocity_is_not_known_where_vectors_are_differences(layers, message, knows, generator):
    """The velocity is the last of the vectors."""
    predict, features = built(generator, layers=layers, message=message)
    moving = features.clone()
    moving[:, -2:] += torch.tensor([2.0, -1.0], dtype=torch.float64)
    assert (not torch.allclose(predict(moving), predict(features), atol=1e-10)) == knows


def test_what_cannot_conserve_momentum_is_refused(generator):
    with pytest.raises(ValidationError, match="needs `normalize = false`"):
        RadialNetSettings(conserves_momentum=True, normalize=True)
    with pytest.raises(ConfigError, match="must be false where a scalar is predicted"):
        RadialNetSettings(conserves_momentum=True).build(INPUTS, None, Kinds(1, 0), 2)
