import pytest
import torch

from cconv.errors import ConfigError, ShapeError
from cconv.neighbors import radius_graph
from cconv.networks import Channels, ConvNet, WallInputs
from cconv.networks.conv_net import ACTIVATIONS, SKIPS
from cconv.nn import ConvGeometry

FULL = Channels(4, (5, 6, 6, 2), walls=3)
CELLS = (3, 3, 3)


@pytest.fixture
def scene(generator):
    fluid = torch.rand(25, 3, generator=generator)
    walls = torch.rand(10, 3, generator=generator)
    geometry = ConvGeometry(radius_graph(fluid, 0.5), 3)
    wall_geometry = ConvGeometry(radius_graph(walls, 0.5, queries=fluid), 3)
    features, normals = torch.randn(25, 4, generator=generator), torch.randn(10, 3, generator=generator)
    return features, geometry, WallInputs(normals, wall_geometry)


def test_published_layer_sizes_and_parameter_count():
    """Ummenhofer et al. 2020: layers 32, 64, 64, 3 with 4 x 4 x 4 filters have 692,902 parameters."""
    net = ConvNet(Channels(4, (32, 64, 64, 3), walls=3), (4, 4, 4))
    assert sum(parameter.numel() for parameter in net.parameters()) == 692_902
    assert [tuple(conv.filters.shape[-2:]) for conv in net.convs] == [(4, 32), (96, 64), (64, 64), (64, 3)]


def test_layers_follow_figure_3_1(scene, generator):
    """The forward pass spelled out: concatenate, then convolution + dense, skip before the activation."""
    features, geometry, walls = scene
    net = ConvNet(FULL, CELLS, generator=generator)
    z = torch.cat(
        [net.boundary_conv(walls.features, walls.geometry), net.convs[0](features, geometry), net.dense[0](features)], 1
    )
    z = net.convs[1](z.relu(), geometry) + net.dense[1](z.relu())
    z = net.convs[2](z.relu(), geometry) + net.dense[2](z.relu()) + z
    z = net.convs[3](z.relu(), geometry) + net.dense[3](z.relu())
    assert torch.equal(net(*scene), z)


def test_a_single_layer_adds_its_branches(scene, generator):
    features, geometry, walls = scene
    net = ConvNet(Channels(4, (2,), walls=3), CELLS, generator=generator)
    expected = (
        net.boundary_conv(walls.features, walls.geometry) + net.convs[0](features, geometry) + net.dense[0](features)
    )
    torch.testing.assert_close(net(*scene), expected)


def test_a_scene_without_boundary_builds_no_convolution_of_the_walls(scene):
    features, geometry, _ = scene
    net = ConvNet(Channels(4, (5, 6, 1)), CELLS)
    assert net.boundary_conv is None
    assert not any("boundary" in name for name, _ in net.named_parameters())
    assert net(features, geometry).shape == (25, 1)
    with pytest.raises(ShapeError, match="convolution of the walls"):
        net(*scene)


def test_a_convolution_of_the_walls_needs_their_inputs(scene):
    features, geometry, _ = scene
    with pytest.raises(ShapeError, match="convolution of the walls"):
        ConvNet(FULL, CELLS)(features, geometry)


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("skip", SKIPS)
@pytest.mark.parametrize("message", ["absolute", "difference"])
def test_every_parameter_gets_a_gradient(activation, skip, message, scene):
    net = ConvNet(FULL, CELLS, activation=activation, skip=skip, message=message)
    net(*scene).square().sum().backward()
    assert all(parameter.grad.abs().sum() > 0 for parameter in net.parameters())


def test_skips_differ_by_what_they_carry(scene):
    outputs = [ConvNet(FULL, CELLS, skip=skip, generator=torch.Generator().manual_seed(1))(*scene) for skip in SKIPS]
    assert not torch.allclose(outputs[0], outputs[1])
    assert not torch.allclose(outputs[1], outputs[2])


def test_initialisations(generator):
    channels = Channels(4, (32, 64, 1))
    xavier, open3d, thesis = (
        ConvNet(channels, (4, 4, 4), initialization=name, generator=generator)
        for name in ("xavier_uniform", "open3d", "thesis")
    )
    assert open3d.convs[1].filters.abs().max() <= 0.05 < xavier.convs[0].filters.abs().max()
    assert all(layer.weight.abs().max() == 0 for layer in thesis.dense)
    assert all(layer.weight.abs().max() > 0 for layer in xavier.dense)
    for net in (xavier, open3d, thesis):
        assert all(layer.bias.abs().max() == 0 for layer in [*net.convs, *net.dense])


def test_bad_names_are_refused():
    with pytest.raises(ConfigError, match="Did you mean 'relu'"):
        ConvNet(FULL, CELLS, activation="rely")
    with pytest.raises(ConfigError, match="`skip`"):
        ConvNet(FULL, CELLS, skip="pre")
    with pytest.raises(ConfigError, match="`layers`"):
        Channels(4, ())
