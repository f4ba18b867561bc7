import json
from dataclasses import replace

import pytest
import torch
from systems import kernel, periodic_frame, periodic_scene, problem, samples, with_walls

from cconv.data.features import inputs_without_density
from cconv.data.targets import make_sample
from cconv.data.trajectory import Boundary
from cconv.errors import ShapeError
from cconv.models.checkpoint import load_model, save_model
from cconv.models.closed_form import solve_closed_form
from cconv.models.model import NetworkConfig, build_field_model

SMALL = NetworkConfig(layers=2, first_channels=4, kernel_size=3)


def test_defaults_have_the_published_sizes_and_filters():
    network = NetworkConfig()
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
    sample = make_sample(frame, scene, "density_rate", kernel(scene))
    torch.testing.assert_close(model.predict_frame(frame, scene), model.predict(sample.inputs))


def test_walls_build_a_boundary_branch_and_are_demanded_later(generator):
    scene = periodic_scene()
    frame = with_walls(periodic_frame(generator))
    walled = [make_sample(frame, scene, "density_rate", kernel(scene))]
    model = build_field_model(SMALL, scene, "density_rate", "cubic_spline", scene.particle_spacing, walled)
    assert model.config.boundary_channels == 2
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
    train = [make_sample(frame, scene, task, kernel(scene))]
    network = NetworkConfig(basis="radial", first_channels=6, hidden_channels=6, radial_terms=5, message=message)
    model = build_field_model(network, scene, task, "cubic_spline", scene.particle_spacing, train, generator)
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


def test_settings_of_the_other_basis_are_refused():
    with pytest.raises(ValueError, match="skip 'after_activation' is for basis 'grid'"):
        NetworkConfig(basis="radial", skip="after_activation")


BASES = [SMALL, NetworkConfig(layers=2, basis="radial", first_channels=4, radial_terms=5)]


def walled_model(network, frame, generator, task="density_rate"):
    """A model of the periodic scene with walls, fitted to one frame."""
    scene = periodic_scene()
    train = [make_sample(frame, scene, task, kernel(scene))]
    model = build_field_model(network, scene, task, "cubic_spline", scene.particle_spacing, train, generator)
    if network.layers == 1:
        solve_closed_form(model, train)
    return model


def with_moved_walls(frame):
    """The frame with its wall points 0.3 spacings higher."""
    up = torch.tensor([0.0, 0.3 / 8])
    return replace(frame, boundary=replace(frame.boundary, positions=frame.boundary.positions + up))


@pytest.mark.parametrize("layers", [1, 2])
@pytest.mark.parametrize("network", BASES, ids=lambda network: network.basis)
def test_only_a_model_with_a_boundary_branch_sees_the_walls(network, layers, generator):
    scene, frame = periodic_scene(), with_walls(periodic_frame(generator))
    moved = with_moved_walls(frame)
    for boundary in (True, False):
        settings = network.model_copy(update={"boundary": boundary, "layers": layers})
        model = walled_model(settings, frame, generator)
        sees = not torch.equal(model.predict_frame(frame, scene), model.predict_frame(moved, scene))
        assert sees == boundary


def test_a_model_without_boundary_branch_takes_scenes_with_and_without_walls(generator):
    scene, frame = periodic_scene(), periodic_frame(generator)
    model = walled_model(SMALL.model_copy(update={"boundary": False}), with_walls(frame), generator)
    assert model.config.boundary_channels == 0
    walled, bare = (model.predict_frame(each, scene) for each in (with_walls(frame), frame))
    assert torch.equal(walled, bare)


@pytest.mark.parametrize("layers", [1, 2])
@pytest.mark.parametrize("network", BASES, ids=lambda network: network.basis)
def test_only_a_model_with_the_density_feature_sees_the_masses(network, layers, generator):
    scene, frame = periodic_scene(), with_walls(periodic_frame(generator))
    heavier = replace(frame, masses=frame.masses * torch.tensor([0.875, 1.125]).repeat(32))  # of the same mean
    for density in (True, False):
        settings = network.model_copy(update={"density": density, "layers": layers})
        model = walled_model(settings, frame, generator)
        sees = not torch.equal(model.predict_frame(frame, scene), model.predict_frame(heavier, scene))
        assert sees == density


@pytest.mark.parametrize("network", BASES, ids=lambda network: network.basis)
def test_a_model_without_density_takes_inputs_with_and_without_it(network, generator):
    scene, frame = periodic_scene(), periodic_frame(generator)
    sample = make_sample(frame, scene, "density_rate", kernel(scene))
    bare = inputs_without_density(frame, scene)
    model = walled_model(network.model_copy(update={"density": False}), frame, generator)
    assert torch.equal(model.predict(sample.inputs), model.predict(bare))
    with pytest.raises(ShapeError, match="expects 4 features .* have 3"):
        walled_model(network, frame, generator).predict(bare)


def test_what_is_switched_off_has_no_parameters(generator):
    """Grid: each branch of the first layer and what the second reads of it; radial: coefficients of the inputs."""
    frame = with_walls(periodic_frame(generator))

    def count(network, **switches):
        return walled_model(network.model_copy(update=switches), frame, generator).num_parameters

    grid, radial = BASES
    cells, first = grid.kernel_size**2, grid.first_channels
    branch = cells * 2 * first + first  # two components of the normal, and a bias
    assert count(grid) - count(grid, boundary=False) == branch + (cells + 1) * first
    assert count(grid) - count(grid, density=False) == (cells + 1) * first
    scalars, vectors = 2 * radial.first_channels, radial.first_channels  # a gate for each vector
    of_a_normal = radial.radial_terms * (scalars + 2 * vectors)  # n·r̂; n and (n·r̂) r̂
    assert count(radial) - count(radial, boundary=False) == of_a_normal
    of_the_density = radial.radial_terms * (scalars + vectors) + scalars
    assert count(radial) - count(radial, density=False) == of_the_density


@pytest.mark.parametrize("basis", ["grid", "radial"])
@pytest.mark.parametrize("switches", [{"boundary": False}, {"density": False}, {"boundary": False, "density": False}])
def test_a_switched_model_is_solved_saved_and_loaded(basis, switches, generator, tmp_path):
    scene, frame = periodic_scene(), with_walls(periodic_frame(generator))
    network = NetworkConfig(layers=1, basis=basis, kernel_size=3, radial_terms=8, message="difference", **switches)
    model = walled_model(network, frame, generator)
    save_model(model, tmp_path / "model", {})
    again = load_model(tmp_path / "model")
    assert torch.equal(again.predict_frame(frame, scene), model.predict_frame(frame, scene))


def test_a_model_stored_before_there_were_switches_has_both(generator, tmp_path):
    frame = with_walls(periodic_frame(generator))
    model = walled_model(SMALL, frame, generator)
    save_model(model, tmp_path / "model", {})
    path = tmp_path / "model" / "config.json"
    stored = json.loads(path.read_text())
    del stored["network"]["boundary"], stored["network"]["density"]
    path.write_text(json.dumps(stored))
    assert load_model(tmp_path / "model").config == model.config
