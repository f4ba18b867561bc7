import pytest
from systems import problem

from cconv.evaluation.cost import flops_per_particle, measure_costs
from cconv.training.checkpoint import load_model, save_model
from cconv.training.field_model import NetworkConfig


def test_flops_of_one_layer_counted_by_hand(generator):
    """4 features to 1 output: multiply first (K² · 4 a particle), read 4 cells an edge, add the dense layer."""
    given = problem(generator)
    model = given.build_model(NetworkConfig(layers=1, kernel_size=3), 0)
    inputs = given.valid_samples[0].inputs
    edges = len(model.geometry(inputs).fluid.reads.senders)
    expected = 2 * (4 * edges / 64 * 1 + 9 * 4 * 1) + 2 * 4
    assert flops_per_particle(model, inputs) == pytest.approx(expected)


def test_wider_networks_cost_more(generator):
    given = problem(generator)
    inputs = given.valid_samples[0].inputs
    costs = [
        flops_per_particle(
            given.build_model(NetworkConfig(layers=3, first_channels=4, hidden_channels=width), 0), inputs
        )
        for width in (4, 8, 16)
    ]
    assert costs == sorted(costs)


def test_measured_costs_are_consistent(generator, tmp_path):
    given = problem(generator)
    save_model(given.build_model(NetworkConfig(layers=1, kernel_size=3), 0), tmp_path / "model", {})
    inputs = [sample.inputs for sample in given.valid_samples]
    cost = measure_costs({"small": tmp_path / "model"}, load_model, inputs, threads=1, repeats=4)["small"]
    assert 0 < cost.ms_low <= cost.ms_per_frame <= cost.ms_high
    assert cost.us_per_particle == pytest.approx(1e3 * cost.ms_per_frame / 64)
    assert 0 < cost.peak_mb < 1000
    assert (cost.threads, cost.num_particles) == (1, 64)
