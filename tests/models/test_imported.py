"""The published ConvNet with weights of its own format: the same answers, and one clear line for other files."""

import itertools
import json
import pickle
from functools import partial
from importlib.util import find_spec

import h5py
import numpy as np
import pytest
import torch
from oracles.published_conv_net import SHAPES, member, step, write_weights
from outcomes import assert_one_clear_line

from cconv.data.trajectory import Boundary, Scene
from cconv.data.window import Window
from cconv.domain import Box
from cconv.errors import ShapeError
from cconv.forces import ConstantForce
from cconv.models.checkpoint import load_model
from cconv.models.imported import published_conv_net
from cconv.neighbors import radius_graph
from cconv.nn import ConvGeometry, continuous_conv
from cconv.rollout.rollout import rollout

GRAVITY = (0.0, -9.81, 0.0)


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    path = tmp_path_factory.mktemp("published") / "weights.h5"
    write_weights(path, torch.Generator().manual_seed(1))
    return path


def scene(dim=3):
    return Scene(
        name="box",
        dim=dim,
        particle_spacing=0.05,
        frame_dt=0.02,
        box=Box([-1] * dim, [2] * dim),
        force=ConstantForce(GRAVITY[:dim]),
        has_boundary=True,
        velocity_source="stored",
        mass_source="stored",
        missing=(),
    )


@pytest.fixture
def fluid(generator):
    """Positions and velocities of a random fluid, and points on a floor with normals."""
    positions = 0.4 * torch.rand(300, 3, generator=generator)
    floor = torch.cat([torch.rand(200, 1, generator=generator), torch.zeros(200, 1)], dim=1)
    walls = 0.4 * torch.cat([floor, torch.rand(200, 1, generator=generator)], dim=1)
    positions[:2] = positions[2:4]  # at the same place, where the published code sees no neighbours
    return positions, torch.randn(300, 3, generator=generator), walls, torch.tensor([[0.0, 1.0, 0.0]]).repeat(200, 1)


def window_of(positions, velocities, walls, normals):
    past = torch.stack([positions.double() - 0.02 * velocities.double(), positions.double()])
    return Window(
        positions=past,
        future=past[:0],
        masses=torch.full((len(positions),), 0.125),
        particle_types=torch.zeros(len(positions), dtype=torch.int64),
        boundary=Boundary(positions=walls, normals=normals),
        trajectory="0",
        frame=1,
    )


def our_conv(features, filters, points, queries, radius, normalize, mapping, window, interpolation, align_corners):
    """The convolution of the package alone, without its networks, models and units."""
    edges = radius_graph(points, radius, queries=queries).apart()
    return continuous_conv(
        features, filters, ConvGeometry(edges, 4, mapping, window, interpolation, align_corners, normalize)
    )


def assert_is_published(conv, weights, fluid):
    model, window = published_conv_net(weights), window_of(*fluid)
    fallen, correction = step(weights, conv, (*fluid, torch.tensor(GRAVITY)))
    ours = model.predict_frame(window, scene())
    assert (ours - correction).abs().max() <= 1e-5 * correction.abs().max()
    following = next(rollout(model, window, scene())).present
    assert (following - (fallen + correction)).abs().max() <= 1e-6


def test_answers_are_those_of_the_published_network(weights, fluid):
    assert_is_published(our_conv, weights, fluid)


@pytest.mark.skipif(find_spec("open3d") is None, reason="needs the extra `parity`")
def test_answers_are_those_of_the_layers_of_open3d(weights, fluid):
    from oracles.open3d_conv import open3d_conv

    assert_is_published(partial(open3d_conv, ignore_query=True), weights, fluid)


def test_the_imported_checkpoint_is_the_model(cconv, weights, fluid, tmp_path):
    status, out, _ = cconv("import", str(weights), "--out", str(tmp_path / "model"), "--json")
    assert status == 0
    assert json.loads(out)["num_parameters"] == 692_902
    model = load_model(tmp_path / "model", task="position_correction")
    expected = published_conv_net(weights).predict_frame(window_of(*fluid), scene())
    assert torch.equal(model.predict_frame(window_of(*fluid), scene()), expected)


def test_without_weights_a_cube_falls_as_the_published_integrator_moves_it(tmp_path, fluid):
    """Displacements grow by g T² / 2 a frame, as velocities are mean ones of a frame."""
    path = tmp_path / "zeros.h5"
    with h5py.File(path, "w") as file:
        for layer, shape in SHAPES.items():
            file[member(layer, "kernel")] = np.zeros(shape, np.float32)
            file[member(layer, "bias")] = np.zeros(shape[-1], np.float32)
    positions, _, *walls = fluid
    start = window_of(positions, torch.zeros_like(positions), *walls)
    path_of_fall = [window.present for window in itertools.islice(rollout(published_conv_net(path), start, scene()), 5)]
    expected = [-9.81 * 0.02**2 / 2 * sum(range(1, frames + 1)) for frames in range(1, 6)]
    found = [(each - start.present)[:, 1] for each in path_of_fall]
    for fall, distance in zip(found, expected, strict=True):
        torch.testing.assert_close(fall, torch.full_like(fall, distance))


def broken(weights, tmp_path, change):
    path = tmp_path / "broken.h5"
    path.write_bytes(weights.read_bytes())
    with h5py.File(path, "a") as file:
        change(file)
    return path


def without(name):
    return lambda file: file.__delitem__(name)


def replaced(name, values):
    def change(file):
        del file[name]
        file[name] = values

    return change


NAME = member("dense2", "kernel")


def external(file):
    del file[NAME]
    file.create_dataset(NAME, (64, 64), "f4", external=[("/etc/passwd", 0, h5py.h5f.UNLIMITED)])


def virtual(file):
    del file[NAME]
    layout = h5py.VirtualLayout((64, 64), "f4")
    layout[:] = h5py.VirtualSource("other.h5", "values", (64, 64))
    file.create_virtual_dataset(NAME, layout)


def unwritten(file):
    del file[NAME]
    file.create_dataset(NAME, (64, 64), "f4")


CHANGES = {
    "a missing tensor": (without(NAME), "is missing"),
    "another shape": (replaced(NAME, np.zeros((64, 63), np.float32)), "(64, 64)"),
    "another type": (replaced(NAME, np.zeros((64, 64))), "float32"),
    "text": (replaced(NAME, "pickle"), "float32"),
    "a link to another file": (replaced(NAME, h5py.ExternalLink("/etc/passwd", "x")), "link to another file"),
    "a link to a tensor of another shape": (
        replaced(NAME, h5py.SoftLink("/" + member("dense1", "kernel"))),
        "(64, 64)",
    ),
    "a link that leads nowhere": (replaced(NAME, h5py.SoftLink("/nowhere")), "leads nowhere"),
    "values outside the file": (external, "outside the file"),
    "values of another file": (virtual, "outside the file"),
    "never written": (unwritten, "never written"),
    "NaN": (replaced(NAME, np.full((64, 64), np.nan, np.float32)), "NaN"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_other_weights_are_refused_in_one_line(name, cconv, weights, tmp_path):
    change, word = CHANGES[name]
    path = broken(weights, tmp_path, change)
    assert_one_clear_line(cconv("import", str(path), "--out", str(tmp_path / "model")), "dense2", word)
    assert {each.name for each in tmp_path.iterdir()} == {"broken.h5"}


class Danger:
    def __reduce__(self):
        return print, ("unpickled",)


def test_a_pickle_is_not_read(cconv, tmp_path):
    path = tmp_path / "weights.pt"
    path.write_bytes(pickle.dumps(Danger()))
    assert_one_clear_line(cconv("import", str(path), "--out", str(tmp_path / "model")), "weights.pt", "no pickle")
    assert {each.name for each in tmp_path.iterdir()} == {"weights.pt"}


def test_a_missing_file_and_a_folder_that_exists_are_refused(cconv, weights, tmp_path):
    assert_one_clear_line(cconv("import", str(tmp_path / "no.h5"), "--out", str(tmp_path / "model")), "no such file")
    assert_one_clear_line(cconv("import", str(weights), "--out", str(tmp_path)), "exists already")


def test_a_scene_of_another_dimension_is_refused(weights, fluid):
    flat = window_of(*(values[:, :2] for values in fluid))
    with pytest.raises(ShapeError, match="3 dimensions, the data have 2"):
        published_conv_net(weights).predict_frame(flat, scene(dim=2))
