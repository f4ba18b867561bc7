import pytest
import torch
from e3nn import o3

from cconv.errors import ConfigError
from cconv.neighbors import radius_graph
from cconv.networks import SEGNNSettings
from cconv.nn.kinds import Kinds, join_kinds, split_kinds
from cconv.tasks import task_named

VELOCITIES = ("one", "accelerations", "velocity")
PUBLISHED = [  # features, parameters of SEGNN-5-64 and SEGNN-10-64 with one and two readout blocks: LagrangeBench
    pytest.param(VELOCITIES, (182_784, 188_992), (358_944, 365_152), id="TGV"),
    pytest.param((*VELOCITIES, "force"), (182_848, 189_056), (359_008, 365_216), id="RPF"),
    pytest.param((*VELOCITIES, "type_one_hot"), (183_360, 189_568), (359_520, 365_728), id="LDC"),
    pytest.param((*VELOCITIES, "type_one_hot", "force"), (183_424, 189_632), (359_584, 365_792), id="DAM"),
]


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(("features", "five", "ten"), PUBLISHED)
def test_numbers_of_parameters_are_the_published_ones(features, five, ten, dim):
    inputs = task_named("acceleration").kinds(features)
    for layers, expected in ((5, five), (10, ten)):
        for readout_layers, number in zip((1, 2), expected, strict=True):
            settings = SEGNNSettings(layers=layers, readout_layers=readout_layers)
            network = settings.build(inputs, None, Kinds(0, 1), dim)
            assert sum(parameter.numel() for parameter in network.parameters()) == number


def small(generator, dim):
    settings = SEGNNSettings(layers=2, hidden_channels=6)
    return settings, settings.build(Kinds(3, 4), None, Kinds(1, 2), dim, generator).double()


@pytest.mark.parametrize("dim", [2, 3])
def test_answers_turn_and_are_mirrored_with_the_scene(dim, generator):
    settings, network = small(generator, dim)
    positions = torch.randn(40, dim, generator=generator, dtype=torch.float64)
    values = torch.randn(40, 2 + 4 * dim, generator=generator, dtype=torch.float64)
    matrix, _ = torch.linalg.qr(torch.randn(dim, dim, generator=generator, dtype=torch.float64))
    mirror = torch.diag(torch.tensor([-1.0] + [1.0] * (dim - 1), dtype=torch.float64))

    def turned(flat, kinds, turn):
        scalars, vectors = split_kinds(flat, kinds, dim)
        return join_kinds(scalars, vectors @ turn.T)

    @torch.no_grad()
    def answer(points, features):
        return network(features, settings.geometry(radius_graph(points, 1.45, include_self=True)))

    for turn in (matrix, matrix @ mirror):
        found = answer(positions @ turn.T, turned(values, Kinds(2, 4), turn))
        expected = turned(answer(positions, values), Kinds(1, 2), turn)
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5 * float(expected.abs().max()))


def test_attributes_of_particles_are_directions_of_motion_and_of_neighbors(generator):
    settings, network = small(generator, 3)
    positions = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    edges = radius_graph(positions, 1.45, include_self=True)
    features = torch.randn(20, 14, generator=generator, dtype=torch.float64)
    seen = []
    network.embedding.register_forward_hook(lambda layer, inputs, output: seen.append(inputs[1]))
    network(features, settings.geometry(edges))
    moving = o3.spherical_harmonics([1], features[:, -3:], normalize=True, normalization="integral")
    apart = o3.spherical_harmonics([1], edges.displacements, normalize=True, normalization="integral")
    for particle in range(20):
        near = apart[edges.receivers == particle].mean(dim=0)
        torch.testing.assert_close(seen[0][particle, 1:], moving[particle] + near)
    assert (seen[0][:, 0] == 1).all()


def test_there_is_no_closed_form(generator):
    with pytest.raises(ConfigError, match="no closed form"):
        small(generator, 2)[1].linear_terms()
