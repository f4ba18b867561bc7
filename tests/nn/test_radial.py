import itertools

import pytest
import torch

from cconv.errors import ConfigError, ShapeError
from cconv.neighbors import radius_graph
from cconv.networks import Channels, RadialNet, WallInputs
from cconv.nn import RadialConv, RadialGeometry
from cconv.nn.kinds import Kinds, join_kinds, split_kinds
from cconv.sph import CubicSpline, density_gradient, density_rate

CUTOFF = 0.4


def normal(generator, *shape):
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def orthogonal(generator, dim, reflect):
    matrix = torch.linalg.qr(normal(generator, dim, dim)).Q
    if (torch.linalg.det(matrix) < 0) != reflect:
        matrix[:, 0] *= -1
    return matrix


def turned(values, channels, matrix):
    scalars, vectors = split_kinds(values, channels, len(matrix))
    return join_kinds(scalars, vectors @ matrix.T)


def dense_radial_conv(layer, features, positions, senders_at, features_at_receivers):
    """The sum over all pairs, with hats and filters written out."""
    dim = positions.shape[1]
    apart = senders_at[None] - positions[:, None]
    distances = apart.norm(dim=2)
    terms = len(layer.scalar_filters)
    hats = (1 - ((distances / CUTOFF * (terms - 1))[..., None] - torch.arange(terms)).abs()).clamp_min(0)
    hats = hats * ((distances > 0) & (distances <= CUTOFF))[..., None]
    directions = apart / torch.where(distances > 0, distances, 1.0)[..., None]
    of_scalars, of_vectors = {
        "absolute": (0, 0), "difference": (-1, -1), "sum": (1, 1), "mixed": (0, -1), "opposite": (1, -1)
    }[layer.message]  # fmt: skip
    sent = features[None].expand(len(positions), -1, -1)
    received = torch.zeros_like(sent) if features_at_receivers is None else features_at_receivers[:, None]
    count = layer.in_channels[0]
    scalars = (sent + of_scalars * received)[..., :count]
    vectors = (sent + of_vectors * received)[..., count:].reshape(*sent.shape[:2], -1, dim)
    along = (vectors * directions[:, :, None]).sum(-1)
    to_scalars = torch.cat([scalars, along], -1)
    to_vectors = torch.cat(
        [
            scalars[..., None] * directions[:, :, None],
            vectors,
            along[..., None] * directions[:, :, None],
        ],
        2,
    )
    return join_kinds(
        torch.einsum("nmb,nmc,bco->no", hats, to_scalars, layer.scalar_filters) + layer.bias,
        torch.einsum("nmb,nmcd,bco->nod", hats, to_vectors, layer.vector_filters),
    )


@pytest.mark.parametrize("message", ["absolute", "difference", "sum", "mixed", "opposite"])
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_agrees_with_the_sum_over_all_pairs(dim, message, generator):
    positions = torch.rand(30, dim, generator=generator, dtype=torch.float64)
    layer = RadialConv(Kinds(2, 3), Kinds(3, 2), 5, dim, message=message, generator=generator).double()
    features = normal(generator, 30, Kinds(2, 3).num_values(dim))
    output = layer(features, RadialGeometry(radius_graph(positions, CUTOFF), 5))
    torch.testing.assert_close(output, dense_radial_conv(layer, features, positions, positions, features))


def test_bipartite_agrees_with_the_sum_over_all_pairs(generator):
    points, queries = (torch.rand(count, 2, generator=generator, dtype=torch.float64) for count in (20, 30))
    layer = RadialConv(Kinds(1, 1), Kinds(2, 1), 4, 2, generator=generator).double()
    features = normal(generator, 20, 3)
    output = layer(features, RadialGeometry(radius_graph(points, CUTOFF, queries=queries), 4))
    torch.testing.assert_close(output, dense_radial_conv(layer, features, queries, points, None))


@pytest.mark.parametrize("reflect", [False, True])
@pytest.mark.parametrize("message", ["absolute", "difference"])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_network_is_equivariant(dim, message, reflect, generator):
    positions, walls = (torch.rand(count, dim, generator=generator, dtype=torch.float64) for count in (60, 20))
    channels = Channels(Kinds(2, 1), (Kinds(6, 4), Kinds(6, 4), Kinds(3, 2)), walls=Kinds(0, 1))
    network = RadialNet(channels, 6, dim, message=message, generator=generator).double()
    features, normals = normal(generator, 60, Kinds(2, 1).num_values(dim)), normal(generator, 20, dim)
    matrix, shift = orthogonal(generator, dim, reflect), normal(generator, dim)

    def output(at, values, walls_at, wall_values):
        fluid = RadialGeometry(radius_graph(at, CUTOFF), 6, window="poly6")
        wall = RadialGeometry(radius_graph(walls_at, CUTOFF, queries=at), 6, window="poly6")
        return network(values, fluid, WallInputs(wall_values, wall))

    expected = turned(output(positions, features, walls, normals), Kinds(3, 2), matrix)
    found = output(
        positions @ matrix.T + shift,
        turned(features, Kinds(2, 1), matrix),
        walls @ matrix.T + shift,
        normals @ matrix.T,
    )
    assert expected.abs().max() > 0.1
    assert (found - expected).abs().max() < 1e-10


def test_one_layer_holds_the_density_rate_and_the_density_gradient(generator):
    """D2 = Σ m (v_i - v_j) · ∇W and D3 = 1/ρ Σ m (ρ_j - ρ_i) ∇W, to the accuracy of hats."""
    positions = torch.rand(200, 3, generator=generator, dtype=torch.float64)
    kernel = CubicSpline(CUTOFF / 2, 3)
    edges = radius_graph(positions, CUTOFF)
    geometry = RadialGeometry(edges, 400)
    masses = torch.ones(200, dtype=torch.float64)
    slope = kernel.derivative(torch.linspace(0, CUTOFF, 400, dtype=torch.float64))
    velocities = normal(generator, 200, 3)
    rate = RadialConv(Kinds(0, 1), Kinds(1, 0), 400, 3, message="difference").double()
    densities = 1 + torch.rand(200, generator=generator, dtype=torch.float64)
    gradient = RadialConv(Kinds(1, 0), Kinds(0, 1), 400, 3, message="difference").double()
    with torch.no_grad():
        rate.scalar_filters[:, 0, 0] = slope  # (v_i - v_j) · ∇_i W = (v_j - v_i) · r̂ W', as ∇_i W = -r̂ W'
        gradient.vector_filters[:, 0, 0] = -slope
        expected = density_rate(masses, velocities, edges, kernel)
        torch.testing.assert_close(
            rate(velocities, geometry)[:, 0], expected, rtol=1e-4, atol=1e-3 * expected.abs().max()
        )
        expected = density_gradient(masses, densities, edges, kernel)
        found = gradient(densities[:, None], geometry) / densities[:, None]
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-3 * expected.abs().max().item())


@pytest.mark.parametrize("message", ["absolute", "difference"])
def test_gradients(message, generator):
    positions = torch.rand(7, 2, generator=generator, dtype=torch.float64).requires_grad_()
    features = normal(generator, 7, 3).requires_grad_()
    layer = RadialConv(Kinds(1, 1), Kinds(2, 1), 3, 2, message=message, generator=generator).double()

    def convolve(at, values, *filters):
        return torch.func.functional_call(
            layer,
            dict(zip(("scalar_filters", "vector_filters"), filters, strict=True)),
            (values, RadialGeometry(radius_graph(at, 0.6), 3)),
        )

    filters = [layer.scalar_filters, layer.vector_filters]
    assert torch.autograd.gradcheck(convolve, (positions, features, *filters))
    fixed = positions.detach()
    assert torch.autograd.gradcheck(lambda *inputs: convolve(fixed, *inputs), (features, *filters))
    assert torch.autograd.gradgradcheck(lambda *inputs: convolve(fixed, *inputs), (features, *filters))


def test_parts_of_a_geometry_keep_the_gradients_it_was_made_with(generator):
    """Whatever the mode in which they are first asked for."""
    positions = torch.rand(12, 2, generator=generator, dtype=torch.float64).requires_grad_()
    layer = RadialConv(Kinds(1, 1), Kinds(1, 1), 3, 2, generator=generator).double()
    features = normal(generator, 12, 3)

    def gradient(geometry):
        return torch.autograd.grad(layer(features, geometry).sum(), positions)[0]

    expected = gradient(RadialGeometry(radius_graph(positions, CUTOFF), 3, window="poly6"))
    for mode in (torch.no_grad(), torch.inference_mode()):
        geometry = RadialGeometry(radius_graph(positions, CUTOFF), 3, window="poly6")
        with mode:
            layer(features, geometry)
            held = geometry.directions, geometry.senders, geometry.edges.displacements, geometry.edges.distances
            by_sender = geometry.weighted_edges.by_sender
            assert geometry.nbytes == sum(each.nbytes for each in (geometry.reads, *held, *by_sender))
        torch.testing.assert_close(gradient(geometry), expected)
    fixed = RadialGeometry(radius_graph(positions, CUTOFF), 3, window="poly6", detach_positions=True)
    assert not fixed.reads.requires_grad
    assert not fixed.directions.requires_grad


def test_prediction_equals_what_is_differentiated(generator):
    """Two layers of few outputs: without gradients all of it takes another path."""
    positions = torch.rand(80, 3, generator=generator, dtype=torch.float64)
    channels = Channels(Kinds(2, 1), (Kinds(4, 4), Kinds(1, 0)))
    network = RadialNet(channels, 6, 3, message="difference", generator=generator).double()
    features, geometry = normal(generator, 80, 5), RadialGeometry(radius_graph(positions, CUTOFF), 6)
    with torch.no_grad():
        predicted = network(features, geometry)
    torch.testing.assert_close(predicted, network(features, geometry).detach(), rtol=1e-12, atol=1e-12)


def test_bias_is_added_to_scalars_alone(generator):
    positions = torch.rand(20, 2, generator=generator, dtype=torch.float64)
    layer = RadialConv(Kinds(1, 1), Kinds(2, 1), 3, 2, generator=generator).double()
    features, geometry = normal(generator, 20, 3), RadialGeometry(radius_graph(positions, CUTOFF), 3)
    with torch.no_grad():
        before = layer(features, geometry)
        layer.bias.copy_(torch.tensor([1.0, -2.0]))
        added = layer(features, geometry) - before
    torch.testing.assert_close(added, torch.tensor([1.0, -2, 0, 0], dtype=torch.float64).expand(20, 4))


def test_no_vectors_no_scalars_no_neighbours(generator):
    positions = torch.tensor([[0.0, 0], [5, 5]], dtype=torch.float64)
    geometry = RadialGeometry(radius_graph(positions, CUTOFF), 3)
    inputs, outputs = [Kinds(2, 0), Kinds(0, 2)], [Kinds(1, 0), Kinds(0, 1), Kinds(2, 2)]
    for channels_in, channels_out in itertools.product(inputs, outputs):
        layer = RadialConv(channels_in, channels_out, 3, 2, generator=generator).double()
        with torch.no_grad():
            layer.bias.fill_(0.5)
        output = layer(normal(generator, 2, channels_in.num_values(2)), geometry)
        scalars, vectors = split_kinds(output, channels_out, 2)
        assert (scalars == 0.5).all()
        assert (vectors == 0).all()


def test_bad_input_is_named(generator):
    edges = radius_graph(torch.rand(10, 2, generator=generator, dtype=torch.float64), CUTOFF)
    with pytest.raises(ConfigError, match="`num_terms`"):
        RadialGeometry(edges, 0)
    with pytest.raises(ConfigError, match="window"):
        RadialGeometry(edges, 3, window="poly")
    layer, geometry = RadialConv(Kinds(1, 1), Kinds(1, 1), 3, 2).double(), RadialGeometry(edges, 3)
    with pytest.raises(ShapeError, match="`features` must have shape \\(10, 3\\)"):
        layer(normal(generator, 10, 4), geometry)
    with pytest.raises(ShapeError, match="3 terms"):
        layer(normal(generator, 10, 3), RadialGeometry(edges, 4))
    with pytest.raises(ShapeError, match="dtype"):
        layer(torch.zeros(10, 3), geometry)
    with pytest.raises(ShapeError, match="finite"):
        layer(torch.full((10, 3), float("nan"), dtype=torch.float64), geometry)
