import pytest
import torch
from systems import kernel, periodic_frame, periodic_scene, with_walls

from cconv.data.features import (
    Units,
    fluid_state,
    inputs_without_density,
    make_inputs,
    standardize_features,
    standardize_vectors,
)
from cconv.data.trajectory import Frame, ParticleType


@pytest.fixture
def state(generator):
    scene = periodic_scene()
    return fluid_state(periodic_frame(generator), scene.box, kernel(scene))


def test_features_are_one_velocity_density(state):
    inputs = make_inputs(state, None, periodic_scene())
    assert inputs.features.shape == (64, 4)
    assert torch.equal(inputs.features[:, 0], torch.ones(64))
    units = Units(length=1 / 8, density=1.0, time=0.01)  # masses are dx²
    assert inputs.units == units
    torch.testing.assert_close(inputs.positions, 8 * state.positions.float())
    torch.testing.assert_close(inputs.features[:, 1:3], 0.08 * state.velocities.float())
    torch.testing.assert_close(inputs.features[:, 3], state.densities.float())
    assert inputs.box.lengths == (8.0, 8.0)
    assert inputs.features.dtype == torch.float32


def test_inputs_without_density_are_the_others_less_the_last_feature(generator):
    scene, frame = periodic_scene(), with_walls(periodic_frame(generator))
    whole = make_inputs(fluid_state(frame, scene.box, kernel(scene)), frame.boundary, scene)
    bare = inputs_without_density(frame, scene)
    assert torch.equal(bare.features, whole.features[:, :-1])
    for name in ("positions", "boundary_positions", "boundary_features"):
        assert torch.equal(getattr(bare, name), getattr(whole, name))


def test_density_of_a_jittered_lattice_is_near_one(state):
    assert state.densities.mean().item() == pytest.approx(1, abs=0.05)


def test_boundary_features_are_normals_or_ones(generator):
    scene = periodic_scene()
    for normals, expected in ((True, torch.tensor([[0.0, 1.0]])), (False, torch.ones(1, 1))):
        frame = with_walls(periodic_frame(generator), normals)
        inputs = make_inputs(fluid_state(frame, scene.box, kernel(scene)), frame.boundary, scene)
        torch.testing.assert_close(inputs.boundary_features, expected.expand(8, -1).clone())


def test_only_fluid_particles_count(generator):
    """Wall particles among the particles change neither density nor features of the fluid."""
    scene, frame = periodic_scene(), periodic_frame(generator)
    walls = Frame(
        positions=torch.cat([frame.positions, frame.positions[:5] + 0.01]),
        velocities=torch.cat([frame.velocities, torch.ones(5, 2)]),
        masses=torch.cat([frame.masses, torch.ones(5)]),
        particle_types=torch.cat([frame.particle_types, torch.full((5,), ParticleType.SOLID_WALL)]),
        boundary=None,
    )
    alone, beside = (fluid_state(which, scene.box, kernel(scene)) for which in (frame, walls))
    assert torch.equal(alone.densities, beside.densities)


def test_standardised_features_keep_the_constant_and_directions(generator):
    features = torch.randn(1000, 4, generator=generator) * torch.tensor([0, 3.0, 0.1, 5]) + torch.tensor([1, 2.0, 0, 9])
    standardization = standardize_features([features[:500], features[500:]])
    standardised = (features - standardization.mean) / standardization.scale
    assert torch.equal(standardised[:, 0], torch.ones(1000, dtype=torch.float64))
    assert standardization.scale[1] == standardization.scale[2]
    torch.testing.assert_close(standardised[:, 1:].mean(0), torch.zeros(3, dtype=torch.float64), atol=1e-6, rtol=0)
    assert standardised[:, 3].std().item() == pytest.approx(1, rel=1e-2)


def test_mean_squared_error_of_standardised_vectors_is_normalised_by_the_variance(generator):
    target = torch.randn(200, 3, generator=generator, dtype=torch.float64) * torch.tensor([1.0, 2, 5])
    scale = standardize_vectors([target]).scale
    variance = target.var(dim=0, correction=0).mean()
    error = torch.full_like(target, 0.3)
    torch.testing.assert_close((error / scale).square().mean(), error.square().mean() / variance)


def test_a_constant_field_keeps_scale_one():
    standardization = standardize_vectors([torch.full((10, 2), 4.0)])
    assert torch.equal(standardization.scale, torch.ones(2, dtype=torch.float64))
