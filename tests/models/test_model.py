from dataclasses import replace

import pytest
import torch
from systems import configured, model_of, periodic_frame, periodic_scene, problem, samples, with_walls

from cconv.data.trajectory import Boundary
from cconv.errors import ConfigError, ShapeError
from cconv.models.checkpoint import load_model, save_model
from cconv.models.closed_form import solve_closed_form
from cconv.models.model import build_model
from cconv.nn.kinds import Kinds
from cconv.tasks import task_named
from cconv.tasks.samples import make_sample

SMALL = configured(layers=2, first_channels=4, kernel_size=3)


def test_defaults_have_the_published_sizes_and_filters():
    network = configured().network
    assert network.hidden_widths == [32, 64, 64]
    assert network.relative_cutoff * 0.05 == pytest.approx(0.225 / 2)
    assert (network.window, network.mapping, network.message) == ("poly6", "ball_to_cube_volume_preserving", "absolute")


def test_standardisation_comes_from_the_training_samples(generator):
    given = problem(generator)
    model = given.build_model(SMALL, 0)
    targets = torch.cat([sample.target for sample in given.train_samples])
    standardised = model.standardize_target(targets)
    assert standardised.mean().abs() < 1e-5
    assert standardised.std(correction=0).item() == pytest.approx(1, rel=1e-5)


def test_a_frame_predicts_as_its_sample(generator):
    scene, frame = periodic_scene(), periodic_frame(generator)
    model = problem(generator).build_model(SMALL, 0)
    sample = make_sample(frame, scene, task_named("density_rate"))
    torch.testing.assert_close(model.predict_frame(frame, scene), model.predict(sample.inputs))


def test_walls_build_a_boundary_branch_and_are_demanded_later(generator):
    scene = periodic_scene()
    frame = with_walls(periodic_frame(generator))
    walled = [make_sample(frame, scene, task_named("density_rate"))]
    model = model_of(SMALL, scene, "density_rate", walled)
    assert model.config.walls == Kinds(0, 1)
    assert model.predict(walled[0].inputs).shape == (64, 1)
    with pytest.raises(ShapeError, match="boundary"):
        model.predict(samples(generator, 1)[0].inputs)


def test_same_seed_same_weights_other_seed_others(generator):
    given = problem(generator)
    first, again, other = (given.build_model(SMALL, seed).network.convs[0].filters for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


@pytest.mark.parametrize("task", ["density_rate", "density_gradient"])
@pytest.mark.parametrize("message", ["absolute", "difference"])
def test_a_radial_model_turns_with_the_scene(task, message, generator):
    scene, frame = periodic_scene(), with_walls(periodic_frame(generator))
    train = [make_sample(frame, scene, task_named(task))]
    network = configured(
        architecture="radial_net", first_channels=6, hidden_channels=6, radial_terms=5, message=message
    )
    model = model_of(network, scene, task, train, generator)
    quarter = torch.tensor([[0.0, -1], [1, 0]])
    box_center = torch.tensor([0.5, 0.5])

    def turn(points):
        return (points - box_center) @ quarter.T + box_center

    turned = replace(
        frame,
        positions=turn(frame.positions),
        velocities=frame.velocities @ quarter.T,
        boundary=Boundary(positions=turn(frame.boundary.positions), normals=frame.boundary.normals @ quarter.T),
    )
    expected = model.predict_frame(frame, scene)
    if task == "density_gradient":
        expected = expected @ quarter.T
    torch.testing.assert_close(
        model.predict_frame(turned, scene), expected, atol=1e-4 * float(expected.abs().max()), rtol=0
    )


def test_settings_of_another_architecture_are_refused():
    with pytest.raises(ConfigError, match="not possible .network.skip: Input should be 'before_activation' or 'none'"):
        configured(architecture="radial_net", skip="after_activation")


BASES = [SMALL, configured(layers=2, architecture="radial_net", first_channels=4, radial_terms=5)]


def walled_model(network, frame, generator, task="density_rate"):
    """A model of the periodic scene with walls, fitted to one frame."""
    scene = periodic_scene()
    train = [make_sample(frame, scene, task_named(task))]
    model = model_of(network, scene, task, train, generator)
    if network.network.layers == 1:
        solve_closed_form(model, train)
    return model


def with_moved_walls(frame):
    """The frame with its wall points 0.3 spacings higher."""
    up = torch.tensor([0.0, 0.3 / 8])
    return replace(frame, boundary=replace(frame.boundary, positions=frame.boundary.positions + up))


@pytest.mark.parametrize("layers", [1, 2])
@pytest.mark.parametrize("network", BASES, ids=lambda each: each.network.architecture)
def test_only_a_model_with_a_boundary_branch_sees_the_walls(network, layers, generator):
    scene, frame = periodic_scene(), with_walls(periodic_frame(generator))
    moved = with_moved_walls(frame)
    for walls in (True, False):
        settings = configured(network, walls=walls, layers=layers)
        model = walled_model(settings, frame, generator)
        sees = not torch.equal(model.predict_frame(frame, scene), model.predict_frame(moved, scene))
        assert sees == walls


def test_a_model_without_boundary_branch_takes_scenes_with_and_without_walls(generator):
    scene, frame = periodic_scene(), periodic_frame(generator)
    model = walled_model(configured(SMALL, walls=False), with_walls(frame), generator)
    assert model.config.walls is None
    walled, bare = (model.predict_frame(each, scene) for each in (with_walls(frame), frame))
    assert torch.equal(walled, bare)


@pytest.mark.parametrize("layers", [1, 2])
@pytest.mark.parametrize("network", BASES, ids=lambda each: each.network.architecture)
def test_only_a_model_with_the_density_feature_sees_the_masses(network, layers, generator):
    scene, frame = periodic_scene(), with_walls(periodic_frame(generator))
    heavier = replace(frame, masses=frame.masses * torch.tensor([0.875, 1.125]).repeat(32))  # of the same mean
    for density in (True, False):
        settings = configured(network, density=density, layers=layers)
        model = walled_model(settings, frame, generator)
        sees = not torch.equal(model.predict_frame(frame, scene), model.predict_frame(heavier, scene))
        assert sees == density


@pytest.mark.parametrize("network", BASES, ids=lambda each: each.network.architecture)
def test_a_model_without_density_takes_inputs_with_and_without_it(network, generator):
    scene, frame = periodic_scene(), periodic_frame(generator)
    sample = make_sample(frame, scene, task_named("density_rate"))
    bare = task_named("density_rate").inputs(frame, scene, ("one", "velocity"))
    model = walled_model(configured(network, density=False), frame, generator)
    assert torch.equal(model.predict(sample.inputs), model.predict(bare))
    with pytest.raises(ShapeError, match="takes the feature 'density', and the inputs hold one, velocity"):
        walled_model(network, frame, generator).predict(bare)


def test_what_is_switched_off_has_no_parameters(generator):
    """Grid: each branch of the first layer and what the second reads of it; radial: coefficients of the inputs."""
    frame = with_walls(periodic_frame(generator))

    def count(network, **switches):
        return walled_model(configured(network, **switches), frame, generator).num_parameters

    (grid, radial), (of_grid, of_radial) = BASES, (each.network for each in BASES)
    cells, first = of_grid.kernel_size**2, of_grid.first_channels
    branch = cells * 2 * first + first  # two components of the normal, and a bias
    assert count(grid) - count(grid, walls=False) == branch + (cells + 1) * first
    assert count(grid) - count(grid, density=False) == (cells + 1) * first
    scalars, vectors = 2 * of_radial.first_channels, of_radial.first_channels  # a gate for each vector
    of_a_normal = of_radial.radial_terms * (scalars + 2 * vectors)  # n·r̂; n and (n·r̂) r̂
    assert count(radial) - count(radial, walls=False) == of_a_normal
    of_the_density = of_radial.radial_terms * (scalars + vectors) + scalars
    assert count(radial) - count(radial, density=False) == of_the_density


@pytest.mark.parametrize("architecture", ["conv_net", "radial_net"])
@pytest.mark.parametrize("switches", [{"walls": False}, {"density": False}, {"walls": False, "density": False}])
def test_a_switched_model_is_solved_saved_and_loaded(architecture, switches, generator, tmp_path):
    scene, frame = periodic_scene(), with_walls(periodic_frame(generator))
    network = configured(
        layers=1, architecture=architecture, kernel_size=3, radial_terms=8, message="difference", **switches
    )
    model = walled_model(network, frame, generator)
    save_model(model, tmp_path / "model", {})
    again = load_model(tmp_path / "model")
    assert torch.equal(again.predict_frame(frame, scene), model.predict_frame(frame, scene))


@pytest.mark.parametrize("features", [["velocity", "denisty"], ["density"], []])
def test_features_that_are_unknown_or_missing_are_named(features, generator):
    scene, task = periodic_scene(), task_named("density_rate")
    sample = make_sample(periodic_frame(generator), scene, task)
    with pytest.raises(ConfigError, match="feature"):
        build_model(SMALL.network, task, features, scene, [sample])
