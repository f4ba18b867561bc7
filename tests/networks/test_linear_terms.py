import pytest
import torch

from cconv.errors import ConfigError
from cconv.models.closed_form import NormalEquations
from cconv.neighbors import radius_graph
from cconv.networks import Channels, ConvNet, RadialNet, WallInputs
from cconv.nn import ConvGeometry, Kinds, RadialGeometry


def normal(generator, *shape):
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


@pytest.fixture
def points(generator):
    fluid, walls = (torch.rand(count, 2, generator=generator, dtype=torch.float64) for count in (80, 30))
    return radius_graph(fluid, 0.3), radius_graph(walls, 0.3, queries=fluid)


def grid(points, message):
    geometries = [ConvGeometry(edges, 3) for edges in points]
    channels = Channels(4, (2,), walls=2)
    return lambda generator: ConvNet(channels, (3, 3), message=message, generator=generator).double(), geometries


def radial(points, message, outputs=(2, 1)):
    geometries = [RadialGeometry(edges, 3, window="poly6") for edges in points]
    channels = Channels(Kinds(2, 1), (Kinds(*outputs),), walls=Kinds(0, 1))
    return lambda generator: RadialNet(channels, 3, 2, message=message, generator=generator).double(), geometries


@pytest.mark.parametrize("message", ["absolute", "difference"])
@pytest.mark.parametrize("make", [grid, radial])
def test_terms_times_coefficients_are_the_network(make, message, points, generator):
    """Coefficients found from a network's own outputs give back its outputs, what its biases add included."""
    build, (fluid, walls) = make(points, message)
    inputs = normal(generator, 80, 4), fluid, WallInputs(normal(generator, 30, 2), walls)
    teacher, student = build(generator), build(generator)
    for name, parameter in teacher.named_parameters():
        if name.endswith("bias"):
            torch.nn.init.normal_(parameter, generator=generator)
    target = teacher(*inputs).detach()
    layer = student.linear_terms()
    assert not torch.allclose(student(*inputs), target)
    solutions = []
    for terms, values in zip(layer.terms(*inputs), layer.targets(target), strict=True):
        equations = NormalEquations(terms.shape[1], values.shape[1])
        equations.add(terms, values)
        solutions.append(equations.solve(1e-13))
    layer.assign(solutions)
    torch.testing.assert_close(student(*inputs), target, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("outputs", [(1, 0), (0, 1)])
def test_scalars_or_vectors_alone(outputs, points, generator):
    build, (fluid, walls) = radial(points, "difference", outputs)
    layer = build(generator).linear_terms()
    terms = layer.terms(normal(generator, 80, 4), fluid, WallInputs(normal(generator, 30, 2), walls))
    targets = layer.targets(normal(generator, 80, 1 if outputs[0] else 2))
    assert len(terms) == len(targets) == 1
    assert len(terms[0]) == len(targets[0])


def test_frame_by_frame_is_least_squares_of_all(generator):
    terms, targets = normal(generator, 50, 6), normal(generator, 50, 2)
    equations = NormalEquations(6, 2)
    for rows in torch.arange(50).split(7):
        equations.add(terms[rows], targets[rows])
    torch.testing.assert_close(equations.solve(0.0), torch.linalg.lstsq(terms, targets).solution)


def test_ridge_shrinks(generator):
    terms, targets = normal(generator, 50, 6), normal(generator, 50, 2)
    equations = NormalEquations(6, 2)
    equations.add(terms, targets)
    norms = [equations.solve(ridge).norm() for ridge in (0, 0.1, 1, 10)]
    assert norms == sorted(norms, reverse=True)


def test_dependent_terms_need_a_ridge(generator):
    terms = normal(generator, 20, 1) * torch.ones(3, dtype=torch.float64)
    equations = NormalEquations(3, 1)
    equations.add(terms, terms[:, :1])
    with pytest.raises(ConfigError, match="`ridge` must be larger"):
        equations.solve(0.0)
    torch.testing.assert_close(equations.solve(1e-10).sum().item(), 1.0)


def test_several_layers_have_no_closed_form():
    with pytest.raises(ConfigError, match="`network.layers` must be 1"):
        ConvNet(Channels(2, (3, 1)), (3, 3)).linear_terms()
