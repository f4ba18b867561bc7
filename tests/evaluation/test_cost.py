import math
import statistics

import pytest
from systems import configured, periodic_frame, periodic_scene, problem

from cconv.data.trajectory import ParticleType
from cconv.evaluation import cost as costs
from cconv.evaluation.cost import (
    ANALYTIC,
    flops_per_particle,
    fluid_block,
    measure_costs,
    measure_growth,
)
from cconv.models.checkpoint import load_model, save_model
from cconv.models.model import ModelConfig
from cconv.neighbors import radius_graph
from cconv.nn.kinds import Kinds
from cconv.sph.operators import density as sum_densities
from cconv.tasks import task_named


def test_flops_of_one_layer_counted_by_hand(generator):
    """4 features to 1 output: multiply first (K² · 4 a particle), read 4 cells an edge, add the dense layer."""
    given = problem(generator)
    model = given.build_model(configured(layers=1, kernel_size=3), 0)
    inputs = given.valid_samples[0].inputs
    edges = len(model.geometry(inputs).fluid.reads.senders)
    expected = 2 * (4 * edges / 64 * 1 + 9 * 4 * 1) + 2 * 4
    assert flops_per_particle(model, inputs) == pytest.approx(expected)


def test_wider_networks_cost_more(generator):
    given = problem(generator)
    inputs = given.valid_samples[0].inputs
    counts = [
        flops_per_particle(given.build_model(configured(layers=3, first_channels=4, hidden_channels=width), 0), inputs)
        for width in (4, 8, 16)
    ]
    assert counts == sorted(counts)


def measured(models, generator, repeats=4, task="density_rate"):
    scene = periodic_scene()
    frames = [periodic_frame(generator) for _ in range(2)]
    return measure_costs(models, load_model, frames, scene, task=task_named(task), threads=1, repeats=repeats)


@pytest.mark.integration
def test_measured_costs_are_consistent(generator, tmp_path):
    models = {"small": saved_models(generator, tmp_path)["small"]}
    found, analytic = measured(models, generator)
    assert found.keys() == models.keys()
    for cost in [*found.values(), analytic]:
        assert len(cost.turns_ms) == 4
        assert cost.ms_per_frame == pytest.approx(statistics.median(cost.turns_ms))
        assert min(cost.turns_ms) <= cost.ms_low <= cost.ms_high <= max(cost.turns_ms)
    assert found["small"].us_per_particle == pytest.approx(1e3 * found["small"].ms_per_frame / 64)
    assert found["small"].peak_mb < 1000
    assert (found["small"].threads, found["small"].num_particles) == (1, 64)


def test_models_and_the_analytic_field_take_turns_on_the_same_frames(generator, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(costs, "peak_megabytes", lambda load, models, *others: dict.fromkeys(models, 1.0))
    monkeypatch.setattr(
        costs, "_time_prediction", lambda model, frame, scene: (seen.append(("model", frame)), (0, 1))[1]
    )
    monkeypatch.setattr(
        costs, "_time_analytic", lambda task, sums, frame, scene: (seen.append((task.name, frame)), (0, 1))[1]
    )
    measured(saved_models(generator, tmp_path), generator, repeats=3)
    turns = [tuple(name for name, _ in seen[k : k + 3]) for k in range(0, 12, 3)]
    assert all(sorted(turn) == ["density_rate", "model", "model"] for turn in turns)
    assert len(set(turns)) > 1  # who comes first changes
    assert all(seen[k][1] is seen[k + 1][1] is seen[k + 2][1] for k in range(0, 12, 3))
    assert seen[0][1] is seen[6][1]
    assert seen[0][1] is not seen[3][1]


def test_the_sum_of_densities_is_timed_where_a_model_needs_it(generator, monkeypatch):
    """What is timed is the prediction from a stored frame, so the density is summed once for the model with density."""
    given, sums = problem(generator), []
    monkeypatch.setattr(
        "cconv.tasks.features.density", lambda *arguments: (sums.append(1), sum_densities(*arguments))[1]
    )
    for density in (False, True):
        model = given.build_model(configured(layers=1, kernel_size=3, density=density), 0)
        costs._time_prediction(model, periodic_frame(generator), periodic_scene())
        assert len(sums) == density


def field(dim, walls=None, spacing=0.1):
    scalars, vectors = walls or Kinds(0, 0)
    return ModelConfig(
        task="density_rate",
        kernel="cubic_spline",
        relative_smoothing_length=1.0,
        dim=dim,
        particle_spacing=spacing,
        features=("one", "density", "velocity", "walls"),
        wall_scalars=scalars,
        wall_vectors=vectors,
        network=configured(layers=1).network,
    )


@pytest.mark.parametrize("walls", [None, Kinds(1, 0), Kinds(0, 1)])
@pytest.mark.parametrize("count", [1, 100, 512])
def test_a_block_is_fluid_of_the_spacing_on_a_wall(count, walls):
    frame, scene = fluid_block(count, field(3, walls))
    block = task_named("density_rate").inputs(frame, scene, ("one", "velocity"))
    assert block.num_particles == len(block.features.scalars) == count
    if count == 512:
        neighbors = radius_graph(block.positions, 1.2).row_splits.diff()
        assert neighbors.double().mean() == pytest.approx(6 * 7 / 8, rel=0.1)  # of a lattice of 8 by 8 by 8
    assert block.wall_kinds == walls
    if walls:
        points = len(block.wall_positions)
        near = radius_graph(block.wall_positions, 1.3, queries=block.positions)
        assert len(near) >= points * min(1, count / points) * 0.9


def test_a_block_stands_on_particles_of_the_walls_that_a_model_knows():
    frame, scene = fluid_block(100, field(2).model_copy(update={"wall_types": (1, 2)}))
    fluid = frame.particle_types == ParticleType.FLUID
    assert int(fluid.sum()) == 100
    assert frame.particle_types[~fluid].tolist() == [1, 2] * 5
    assert not frame.velocities[~fluid].any()
    near = radius_graph(frame.positions[fluid], 1.3 * scene.particle_spacing, queries=frame.positions[~fluid])
    assert len(near) >= 9


def saved_models(generator, tmp_path):
    given = problem(generator)
    for name, layers in (("small", 1), ("large", 3)):
        network = configured(layers=layers, first_channels=4, hidden_channels=4, kernel_size=3)
        save_model(given.build_model(network, 0), tmp_path / name, {})
    return {name: tmp_path / name for name in ("small", "large")}


def test_growth_is_measured_at_every_size(generator, tmp_path):
    growth = measure_growth(
        saved_models(generator, tmp_path),
        load_model,
        analytic=field(2),
        sizes=(30, 60, 2000),
        threads=1,
        repeats=3,
    )
    assert list(growth) == ["small", "large", ANALYTIC]
    for each in growth.values():
        assert [time.num_particles for time in each.times] == [30, 60, 2000]
        assert all(time.ms_low <= time.ms_per_frame <= time.ms_high for time in each.times)
        assert each.left_out == ()
        assert math.isfinite(each.exponent)


def test_models_stop_growing_once_a_frame_takes_too_long(generator, tmp_path, monkeypatch):
    """A clock of our own: time is proportional to the number of particles, and to that of layers squared."""

    def time_of(model, frame, scene):
        return 0.0, 1e-3 * len(frame.positions) * model.config.network.layers**2

    monkeypatch.setattr(costs, "_time_prediction", time_of)
    models = saved_models(generator, tmp_path)
    growth = measure_growth(models, load_model, sizes=(100, 200, 400), threads=1, repeats=2, max_seconds=0.3)
    assert [time.ms_per_frame for time in growth["small"].times] == pytest.approx([100, 200, 400])
    assert growth["small"].exponent == pytest.approx(1)
    assert [time.num_particles for time in growth["large"].times] == [100]
    assert growth["large"].left_out == (200, 400)
    assert math.isnan(growth["large"].exponent)
