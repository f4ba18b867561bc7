import math

import pytest
import torch
from systems import kernel, periodic_frame, periodic_scene, problem

from cconv.data.features import fluid_state
from cconv.data.targets import TASKS, make_sample
from cconv.evaluation import cost as costs
from cconv.evaluation.cost import flops_per_particle, fluid_block, measure_analytic, measure_costs, measure_growth
from cconv.neighbors import radius_graph
from cconv.training.checkpoint import load_model, save_model
from cconv.training.field_model import FieldConfig, NetworkConfig


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
    counts = [
        flops_per_particle(
            given.build_model(NetworkConfig(layers=3, first_channels=4, hidden_channels=width), 0), inputs
        )
        for width in (4, 8, 16)
    ]
    assert counts == sorted(counts)


def test_measured_costs_are_consistent(generator, tmp_path):
    given = problem(generator)
    save_model(given.build_model(NetworkConfig(layers=1, kernel_size=3), 0), tmp_path / "model", {})
    inputs = [sample.inputs for sample in given.valid_samples]
    cost = measure_costs({"small": tmp_path / "model"}, load_model, inputs, threads=1, repeats=4)["small"]
    assert 0 < cost.ms_low <= cost.ms_per_frame <= cost.ms_high
    assert cost.us_per_particle == pytest.approx(1e3 * cost.ms_per_frame / 64)
    assert 0 < cost.peak_mb < 1000
    assert (cost.threads, cost.num_particles) == (1, 64)


def test_the_analytic_field_is_timed_on_the_states_and_left_as_it_is(generator):
    """The field that is timed is the target of the samples, in float32."""
    scene = periodic_scene()
    spline, state = kernel(scene), fluid_state(periodic_frame(generator), scene.box, kernel(scene)).single()
    seen = []

    def field_of(state, kernel):
        seen.append(TASKS["density_rate"](state, kernel))

    times = measure_analytic([state], scene.box, field_of, spline, threads=1, repeats=3)
    assert 0 < times["ms_low"] <= times["ms_per_frame"] <= times["ms_high"]
    exact = make_sample(periodic_frame(torch.Generator().manual_seed(0)), scene, "density_rate", spline).target
    assert all(torch.allclose(field, exact, atol=1e-5 * exact.abs().max()) for field in seen)
    assert len(seen) == 4


def field(dim, boundary_channels, spacing=0.1):
    return FieldConfig(
        task="density_rate",
        dim=dim,
        particle_spacing=spacing,
        kernel="cubic_spline",
        smoothing_length=spacing,
        boundary_channels=boundary_channels,
        network=NetworkConfig(layers=1),
    )


@pytest.mark.parametrize("channels", [0, 1, 3])
@pytest.mark.parametrize("count", [1, 100, 512])
def test_a_block_is_fluid_of_the_spacing_on_a_wall(count, channels):
    block = fluid_block(count, field(3, channels))
    assert block.num_particles == len(block.features) == count
    if count == 512:
        neighbors = radius_graph(block.positions, 0.12).row_splits.diff()
        assert neighbors.double().mean() == pytest.approx(6 * 7 / 8, rel=0.1)  # of a lattice of 8 by 8 by 8
    if channels:
        assert block.boundary_features.shape == (len(block.boundary_positions), channels)
        near = radius_graph(block.boundary_positions, 0.13, queries=block.positions)
        assert len(near) >= len(block.boundary_positions) * min(1, count / len(block.boundary_positions)) * 0.9
    else:
        assert block.boundary_positions is None


def saved_models(generator, tmp_path):
    given = problem(generator)
    for name, layers in (("small", 1), ("large", 3)):
        network = NetworkConfig(layers=layers, first_channels=4, hidden_channels=4, kernel_size=3)
        save_model(given.build_model(network, 0), tmp_path / name, {})
    return {name: tmp_path / name for name in ("small", "large")}


def test_growth_is_measured_at_every_size(generator, tmp_path):
    growth = measure_growth(saved_models(generator, tmp_path), load_model, sizes=(30, 60, 2000), threads=1, repeats=3)
    for each in growth.values():
        assert [time.num_particles for time in each.times] == [30, 60, 2000]
        assert all(0 < time.ms_low <= time.ms_per_frame <= time.ms_high for time in each.times)
        assert each.left_out == ()
        assert math.isfinite(each.exponent)


def test_models_stop_growing_once_a_frame_takes_too_long(generator, tmp_path, monkeypatch):
    """A clock of our own: time is proportional to the number of particles, and to that of layers squared."""

    def time_of(model, inputs):
        return 0.0, 1e-3 * inputs.num_particles * model.config.network.layers**2

    monkeypatch.setattr(costs, "_time_prediction", time_of)
    models = saved_models(generator, tmp_path)
    growth = measure_growth(models, load_model, sizes=(100, 200, 400), threads=1, repeats=2, max_seconds=0.3)
    assert [time.ms_per_frame for time in growth["small"].times] == pytest.approx([100, 200, 400])
    assert growth["small"].exponent == pytest.approx(1)
    assert [time.num_particles for time in growth["large"].times] == [100]
    assert growth["large"].left_out == (200, 400)
    assert math.isnan(growth["large"].exponent)
