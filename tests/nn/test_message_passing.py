import pytest
import torch

from cconv.domain import Box
from cconv.neighbors import radius_graph
from cconv.nn.message_passing import MLP, MessagePassing, PairGeometry, segment_sums


@pytest.fixture
def edges(generator):
    positions = torch.rand(40, 2, generator=generator, dtype=torch.float64)
    return radius_graph(positions, 0.2, Box([0, 0], [1, 1], True), include_self=True)


def normal(generator, *shape):
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def test_sums_are_those_of_scattered_additions(edges, generator):
    values = normal(generator, len(edges), 3).requires_grad_()
    weights = normal(generator, 40, 3)
    found = segment_sums(values, edges.row_splits)
    expected = torch.zeros(40, 3, dtype=torch.float64).index_add(0, edges.receivers, values)
    torch.testing.assert_close(found, expected)
    gradients = [torch.autograd.grad((sums * weights).sum(), values)[0] for sums in (found, expected)]
    torch.testing.assert_close(*gradients)


def test_a_receiver_without_neighbors_has_the_sum_0():
    apart = radius_graph(torch.tensor([[0.0, 0.0], [0.1, 0.0], [5.0, 5.0]]), 0.2)
    assert segment_sums(torch.ones(2, 1), apart.row_splits).tolist() == [[1.0], [1.0], [0.0]]


def test_parts_are_multiplied_as_if_they_stood_side_by_side(edges, generator):
    perceptron = MLP([2, 3, 3], [5], 4, generator=generator).double()
    pairs, particles = normal(generator, len(edges), 2), normal(generator, 40, 3)
    together = torch.cat([pairs, particles[edges.senders], particles[edges.receivers]], dim=1)
    expected = perceptron.norm(perceptron.layers[1](perceptron.layers[0](together).relu()))
    found = perceptron(pairs, (particles, edges.senders), (particles, edges.receivers))
    torch.testing.assert_close(found, expected)


def test_a_step_is_that_of_the_paper_for_every_pair_and_particle(edges, generator):
    """Written for one pair and one particle at a time."""
    step = MessagePassing(4, [6], generator=generator).double()
    pairs, particles = normal(generator, len(edges), 4), normal(generator, 40, 4)
    following, updated = step(particles, pairs, edges)
    sums = torch.zeros(40, 4, dtype=torch.float64)
    for number, (i, j) in enumerate(zip(edges.receivers.tolist(), edges.senders.tolist(), strict=True)):
        message = _whole(step.of_pairs, torch.cat([pairs[number], particles[j], particles[i]]))
        torch.testing.assert_close(updated[number], pairs[number] + message)
        sums[i] += message
    for i in range(40):
        added = _whole(step.of_particles, torch.cat([particles[i], sums[i]]))
        torch.testing.assert_close(following[i], particles[i] + added)


def _whole(perceptron, values):
    hidden, output = perceptron.layers
    answer = output(hidden(values).clamp(min=0))
    apart = answer - answer.mean()
    return perceptron.norm.weight * apart / (apart.square().mean() + 1e-5).sqrt() + perceptron.norm.bias


def test_initial_weights_are_cut_off_at_two_deviations_of_the_fan(generator):
    first, second = MLP([60, 40], [50], 7, generator=generator).layers
    for layer, inputs in ((first, 100), (second, 50)):
        assert layer.weight.abs().max() <= 2 * inputs**-0.5
        assert layer.weight.std().item() == pytest.approx(0.88 * inputs**-0.5, rel=0.1)
        assert layer.bias.abs().max() == 0


def test_pairs_know_displacement_and_distance_in_cutoffs(edges):
    features = PairGeometry(edges).features
    torch.testing.assert_close(features[:, :2].norm(dim=1), features[:, 2])
    assert features[:, 2].max() <= 1
    assert (features[edges.receivers == edges.senders] == 0).all()
    torch.testing.assert_close(0.2 * features[:, :2], edges.displacements)
