"""Agreement with Open3D: recorded outputs always, random comparisons where it is installed (extra `parity`)."""

from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from safetensors import safe_open

from cconv.neighbors import radius_graph
from cconv.nn import ConvGeometry, continuous_conv
from cconv.nn.filters import INTERPOLATIONS, MAPPINGS, WINDOWS

RECORDED = Path(__file__).parents[1] / "data" / "open3d_conv.safetensors"
TOLERANCE = 1e-5  # of the largest value: the target that ours is held to


@pytest.fixture(scope="module")
def recorded():
    with safe_open(RECORDED, "pt") as file:
        settings = file.metadata()["settings"].split(";")
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dictionary)
        return tensors, dict(zip(settings, tensors["outputs"], strict=True)), float(file.metadata()["radius"])


def assert_agrees(ours, theirs):
    assert (ours - theirs).abs().max() <= TOLERANCE * theirs.abs().max()


@pytest.mark.parametrize("mapping", MAPPINGS)
@pytest.mark.parametrize("window", WINDOWS)
@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
@pytest.mark.parametrize("align_corners", [True, False])
@pytest.mark.parametrize("normalize", [True, False])
def test_recorded_outputs(recorded, mapping, window, interpolation, align_corners, normalize):
    tensors, outputs, radius = recorded
    edges = radius_graph(tensors["points"], radius, queries=tensors["queries"])
    geometry = ConvGeometry(edges, (3, 4, 2), mapping, window, interpolation, align_corners, normalize)
    theirs = outputs["|".join(map(str, (mapping, window, interpolation, align_corners, normalize)))]
    assert_agrees(continuous_conv(tensors["features"], tensors["filters"], geometry), theirs)
    assert theirs[-1].abs().max() == 0  # the query without neighbours


@pytest.mark.skipif(find_spec("open3d") is None, reason="needs the extra `parity`")
@pytest.mark.parametrize("seed", range(200))
def test_random_settings(seed):
    from oracles.open3d_conv import open3d_conv

    generator = torch.Generator().manual_seed(seed)

    def draw(values):
        return list(values)[int(torch.randint(len(values), (), generator=generator))]

    settings = {
        "mapping": draw(MAPPINGS),
        "window": draw(WINDOWS),
        "interpolation": draw(INTERPOLATIONS),
        "align_corners": draw((True, False)),
        "normalize": draw((True, False)),
    }
    sizes = tuple(draw((1, 2, 3, 4, 5, 6, 8)) for _ in range(3))
    in_channels, out_channels = draw((1, 3, 8, 33)), draw((1, 2, 7, 32))
    count, ignore_query = draw((1, 7, 100, 400)), draw((True, False))
    points = torch.rand(count, 3, generator=generator)
    if count > 50 and not ignore_query:  # Open3D leaves out all points at the query's place, we the query alone
        points[:10] = points[10:20]
    features = torch.randn(count, in_channels, generator=generator)
    filters = torch.randn(*sizes, in_channels, out_channels, generator=generator)
    radius = draw((0.02, 0.1, 0.3))
    theirs = open3d_conv(features, filters, points, points, radius, ignore_query=ignore_query, **settings)
    edges = radius_graph(points, radius, include_self=not ignore_query)
    ours = continuous_conv(features, filters, ConvGeometry(edges, sizes, **settings))
    assert_agrees(ours, theirs)


@pytest.mark.skipif(find_spec("open3d") is None, reason="needs the extra `parity`")
def test_gradients_with_respect_to_features_and_filters():
    from oracles.open3d_conv import open3d_conv

    generator = torch.Generator().manual_seed(0)
    points = torch.rand(300, 3, generator=generator)
    settings = {
        "mapping": "ball_to_cube_volume_preserving", "window": "poly6", "interpolation": "linear",
        "align_corners": True, "normalize": True,
    }  # fmt: skip
    inputs = [torch.randn(300, 6, generator=generator), torch.randn(4, 4, 4, 6, 5, generator=generator)]
    for tensor in inputs:
        tensor.requires_grad_()
    weights = torch.randn(300, 5, generator=generator)
    theirs = open3d_conv(*inputs, points, points, 0.3, **settings)
    ours = continuous_conv(*inputs, ConvGeometry(radius_graph(points, 0.3, include_self=True), 4, **settings))
    for mine, other in zip(
        torch.autograd.grad(ours, inputs, weights), torch.autograd.grad(theirs, inputs, weights), strict=True
    ):
        assert_agrees(mine, other)
