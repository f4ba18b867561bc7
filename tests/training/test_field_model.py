from dataclasses import replace

import pytest
import torch
from systems import kernel, periodic_frame, periodic_scene, problem, samples, with_walls

from cconv.data.targets import make_sample
from cconv.data.trajectory import Boundary
from cconv.errors import ShapeError
from cconv.training.field_model import NetworkConfig, build_field_model

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
    torch.testing.assert_close(model.predict_frame(frame, scene.box), model.predict(sample.inputs))


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
    expected = model.predict_frame(frame, scene.box)
    if task == "density_gradient":
        expected = expected @ quarter.T
    torch.testing.assert_close(
        model.predict_frame(turned, scene.box), expected, atol=1e-4 * float(expected.abs().max()), rtol=0
    )


def test_settings_of_the_other_basis_are_refused():
    with pytest.raises(ValueError, match="skip 'after_activation' is for basis 'grid'"):
        NetworkConfig(basis="radial", skip="after_activation")
