import pytest
import torch

from cconv.errors import ConfigError
from cconv.neighbors import radius_graph
from cconv.networks import GNSSettings
from cconv.nn.kinds import Kinds
from cconv.tasks import task_named

VELOCITIES = ("one", "type_one_hot", "accelerations", "velocity")
FORCED = (*VELOCITIES, "force")
PUBLISHED = [  # dimension, features, parameters of GNS-5-64 and GNS-10-128: LagrangeBench
    pytest.param(2, VELOCITIES, 160_914, 1_211_538, id="TGV2D, LDC2D"),
    pytest.param(2, FORCED, 161_042, 1_211_794, id="RPF2D, DAM2D"),
    pytest.param(3, VELOCITIES, 161_363, 1_212_435, id="TGV3D, LDC3D"),
    pytest.param(3, FORCED, 161_555, 1_212_819, id="RPF3D"),
]


@pytest.mark.parametrize(("dim", "features", "small", "large"), PUBLISHED)
def test_numbers_of_parameters_are_the_published_ones(dim, features, small, large):
    inputs = task_named("acceleration").kinds(features)
    for settings, expected in ((GNSSettings(layers=5, hidden_channels=64), small), (GNSSettings(), large)):
        network = settings.build(inputs, None, Kinds(0, 1), dim)
        assert sum(parameter.numel() for parameter in network.parameters()) == expected


def small(generator):
    settings = GNSSettings(layers=2, hidden_channels=12, embedding=5)
    return settings, settings.build(Kinds(4, 2), None, Kinds(1, 1), 2, generator).double()


def test_particles_without_scalars_have_no_embedding(generator):
    network = GNSSettings(layers=1, hidden_channels=4).build(Kinds(1, 1), None, Kinds(0, 1), 2, generator).double()
    assert network.embedding is None
    positions, values = torch.rand(2, 20, 2, generator=generator, dtype=torch.float64)
    assert network(values, GNSSettings().geometry(radius_graph(positions, 0.3))).shape == (20, 2)


def test_a_message_travels_one_cutoff_in_a_step(generator):
    positions = torch.tensor([[float(place), 0.0] for place in range(6)], dtype=torch.float64)
    settings, network = small(generator)
    geometry = settings.geometry(radius_graph(positions, 1.45, include_self=True))
    features = torch.randn(6, 7, generator=generator, dtype=torch.float64).requires_grad_()
    network(features, geometry)[0].sum().backward()
    assert (features.grad.abs().sum(dim=1) > 0).tolist() == [True, True, True, False, False, False]


def test_there_is_no_closed_form(generator):
    with pytest.raises(ConfigError, match="no closed form"):
        small(generator)[1].linear_terms()
