"""Every learned value of every kind of model can act, and none gives a rate of density to what does not change."""

import itertools
from dataclasses import replace

import pytest
import torch
from systems import configured, model_of, periodic_frame, periodic_scene, with_walls

from cconv.data.trajectory import Boundary
from cconv.models.closed_form import solve_closed_form
from cconv.networks import ConvNetSettings
from cconv.nn.kinds import Kinds
from cconv.tasks import task_named
from cconv.tasks.samples import make_sample

KINDS = [
    {"architecture": architecture, "message": message, "layers": layers, "walls": walls, "density": density}
    for architecture, message, layers, walls, density in itertools.product(
        ("conv_net", "radial_net"), ("absolute", "difference"), (1, 3), (True, False), (True, False)
    )
]


def network_of(kind):
    return configured(
        first_channels=3,
        hidden_channels=3,
        kernel_size=3,
        radial_terms=4,
        activation="tanh",
        relative_cutoff=2.9,
        **kind,
    )


def built(network, task, generator):
    scene, points = periodic_scene(), torch.rand(96, 2, generator=generator)
    normals = torch.nn.functional.normalize(torch.randn(32, 2, generator=generator))
    walls = Boundary(positions=points[64:], normals=normals)
    frame = replace(periodic_frame(generator), positions=points[:64], boundary=walls)
    train = [make_sample(frame, scene, task_named(task))]
    return model_of(network, scene, task, train, generator), train[0]


@pytest.mark.parametrize("task", ["density_rate", "density_gradient"])
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: "-".join(map(str, kind.values())))
def test_every_parameter_gets_a_gradient(kind, task, generator):
    model, sample = built(network_of(kind), task, generator)
    if kind["layers"] == 1:
        output = model(sample.inputs, model.geometry(sample.inputs))
        ways = torch.randn(output.shape, generator=generator)
        (output * ways).sum().backward()
    else:
        with torch.no_grad():  # of vectors that are 0, gates learn nothing
            for parameter in model.parameters():
                parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator))
        model(sample.inputs, model.geometry(sample.inputs)).square().sum().backward()
    for name, parameter in model.named_parameters():
        assert (parameter.grad != 0).all() if parameter.numel() else True, name


@pytest.mark.parametrize("architecture", ["conv_net", "radial_net"])
@pytest.mark.parametrize("task", ["density_rate", "density_gradient"])
@pytest.mark.parametrize("density", [True, False])
def test_no_two_coefficients_of_a_layer_of_differences_do_the_same(architecture, task, density, generator):
    """The layer as a linear map of its coefficients has full rank."""
    kind = {"architecture": architecture, "message": "difference", "layers": 1, "walls": True, "density": density}
    rows = []
    for _ in range(3):
        model, sample = built(network_of(kind), task, generator)
        inputs = sample.inputs.double()
        rows.append(model.network.linear_terms().terms(*model.network_inputs(inputs, model.geometry(inputs))))
    for terms in (torch.cat(same) for same in zip(*rows, strict=True)):
        values = torch.linalg.svdvals(terms / terms.norm(dim=0))
        assert values.min() > 1e-6 * values.max()


def test_eight_radial_terms_on_velocities_have_eight_parameters(generator):
    network = configured(
        layers=1, architecture="radial_net", radial_terms=8, message="difference", walls=False, density=False
    )
    assert built(network, "density_rate", generator)[0].num_parameters == 8


@pytest.mark.parametrize("layers", [1, 2, 4])
@pytest.mark.parametrize("architecture", ["conv_net", "radial_net"])
def test_a_rigid_translation_gives_no_rate_at_all(architecture, layers, generator):
    settings = {
        "architecture": architecture,
        "message": "difference",
        "layers": layers,
        "walls": False,
        "density": False,
    }
    model, sample = built(network_of(settings), "density_rate", generator)
    if layers == 1:
        solve_closed_form(model, [sample])
    scene = periodic_scene()
    frame = periodic_frame(generator)
    assert model.predict_frame(frame, scene).abs().max() > 0
    for velocity in ([0.0, 0.0], [3.7, -0.1], [1e4, 1e4]):
        frame.velocities[:] = torch.tensor(velocity)
        assert (model.predict_frame(frame, scene) == 0).all()


@pytest.mark.parametrize("kind", [{"walls": True, "density": True}, {"walls": False, "density": True}])
def test_differences_predict_the_same_rate_in_every_frame_of_reference(kind, generator):
    network = network_of({"architecture": "radial_net", "message": "difference", "layers": 2, **kind})
    model, _ = built(network, "density_rate", generator)
    frame, scene = with_walls(periodic_frame(generator)), periodic_scene()
    expected = model.predict_frame(frame, scene)
    frame.velocities[:] += torch.tensor([0.5, -2.0])
    torch.testing.assert_close(model.predict_frame(frame, scene), expected, rtol=1e-4, atol=1e-4)


def test_the_published_network_keeps_its_parameters():
    network = ConvNetSettings().build(Kinds(1, 1), Kinds(0, 1), Kinds(0, 1), 3)
    assert sum(parameter.numel() for parameter in network.parameters()) == 692_902
