"""Steered linear maps are e3nn's fully connected tensor products; what is built of them turns with its inputs."""

import sys

import pytest
import torch
from e3nn import o3

from cconv.errors import ConfigError
from cconv.neighbors import radius_graph
from cconv.nn.kinds import Kinds
from cconv.nn.steerable import (
    GatedBlock,
    Steerable,
    SteerableGeometry,
    SteerableMessagePassing,
    SteeredLinear,
    in_space,
    spherical_harmonics,
)


def normal(generator, *shape):
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def steerable(generator, rows, kinds):
    return Steerable(normal(generator, rows, kinds.scalars), normal(generator, rows, 3, kinds.vectors))


def flat(values):
    """As e3nn orders them: scalars, then the components of each vector."""
    return torch.cat([values.scalars, values.vectors.transpose(1, 2).flatten(1)], dim=1)


def irreps(kinds):
    return f"{kinds.scalars}x0e + {kinds.vectors}x1o"


@pytest.mark.parametrize(("inputs", "outputs"), [(Kinds(3, 4), Kinds(2, 5)), (Kinds(0, 5), Kinds(3, 3))])
def test_a_steered_linear_map_is_a_fully_connected_tensor_product(inputs, outputs, generator):
    layer = SteeredLinear(inputs, outputs, generator).double()
    product = o3.FullyConnectedTensorProduct(
        irreps(inputs),
        "1x0e + 1x1o",
        irreps(outputs),
        irrep_normalization="component",
        path_normalization="none",
        internal_weights=False,
        shared_weights=True,
    ).double()
    weights = {"scalar": layer.scalar_weights.split(inputs), "vector": layer.vector_weights.split(inputs)}
    ordered = [weights[("scalar", "vector")[path.i_out]][path.i_in1].flatten() for path in product.instructions]
    values, attributes = steerable(generator, 20, inputs), normal(generator, 20, 4)
    expected = product(flat(values), attributes, torch.cat(ordered))
    torch.testing.assert_close(flat(layer(values, attributes)), expected)


def test_initial_weights_are_within_the_bound_of_the_fan(generator):
    layer = SteeredLinear(Kinds(10, 15), Kinds(20, 20), generator)
    for weights in (layer.scalar_weights, layer.vector_weights):
        assert 0.19 < weights.abs().max() <= 0.2
    assert layer.bias.abs().max() == 0


def test_harmonics_are_the_direction_and_have_the_integral_1(generator):
    vectors = normal(generator, 5, 3)
    vectors[0] = 0
    found = spherical_harmonics()(vectors)
    torch.testing.assert_close(found[:, 0], torch.full((5,), 0.282095).double(), atol=1e-6, rtol=0)
    expected = 0.488603 * torch.nn.functional.normalize(vectors, dim=1)
    torch.testing.assert_close(found[:, 1:], expected, atol=1e-6, rtol=0)


def test_gains_keep_the_mean_square_of_normal_values(generator):
    block = GatedBlock(Kinds(1, 1), 1, generator).double()
    values = normal(generator, 200_000)
    with torch.no_grad():
        block.steered.scalar_weights.copy_(torch.eye(2))
        block.steered.vector_weights.copy_(torch.tensor([[0.0], [1.0]]))
    vector = torch.ones(len(values), 3, 1, dtype=torch.float64)
    attributes = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).expand(len(values), 4)
    passed = block(Steerable(values[:, None], vector), attributes)
    assert passed.scalars.square().mean().item() == pytest.approx(1, abs=0.01)
    with torch.no_grad():
        block.steered.scalar_weights.copy_(torch.tensor([[0.0, 1.0], [0.0, 0.0]]))
    gated = block(Steerable(values[:, None], vector), attributes)
    assert gated.vectors.square().mean().item() == pytest.approx(1, abs=0.01)


def turned(values, matrix):
    return Steerable(values.scalars, torch.einsum("xy,nyv->nxv", matrix, values.vectors))


@pytest.mark.parametrize("reflected", [False, True])
def test_a_step_turns_and_is_mirrored_with_its_inputs(reflected, generator):
    matrix, _ = torch.linalg.qr(normal(generator, 3, 3))
    matrix = matrix * matrix.det() * (-1 if reflected else 1)
    positions, values = normal(generator, 30, 3), steerable(generator, 30, Kinds(4, 4))
    step, harmonics = SteerableMessagePassing(4, generator).double(), spherical_harmonics()

    def answer(points, given):
        geometry = SteerableGeometry(radius_graph(points, 1.5, include_self=True), harmonics)
        return step(given, geometry, geometry.mean_attributes)

    found, expected = answer(positions @ matrix.T, turned(values, matrix)), turned(answer(positions, values), matrix)
    torch.testing.assert_close(flat(found), flat(expected), atol=1e-10, rtol=1e-10)


def test_vectors_of_a_plane_stay_in_it(generator):
    geometry = SteerableGeometry(radius_graph(normal(generator, 30, 2), 1.5), spherical_harmonics())
    values = steerable(generator, 30, Kinds(4, 4))
    values.vectors[:, 2] = 0
    found = SteerableMessagePassing(4, generator).double()(values, geometry, geometry.mean_attributes)
    assert found.vectors[:, 2].abs().max() == 0
    assert torch.equal(in_space(torch.ones(2, 2)), torch.tensor([[1.0, 1, 0], [1, 1, 0]]))


def test_sums_are_those_of_each_kind(generator):
    edges = radius_graph(normal(generator, 10, 2), 1.5)
    values = steerable(generator, len(edges), Kinds(2, 3))
    found = values.summed(edges.row_splits)
    for name in ("scalars", "vectors"):
        part = getattr(values, name)
        expected = torch.zeros(10, *part.shape[1:], dtype=torch.float64).index_add(0, edges.receivers, part)
        torch.testing.assert_close(getattr(found, name), expected)


def test_without_e3nn_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "e3nn.o3", None)
    with pytest.raises(ConfigError, match=r"pip install 'cconv\[segnn\]'"):
        spherical_harmonics()
