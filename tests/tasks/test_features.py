import pytest
import torch
from systems import kernel, periodic_frame, periodic_scene, with_walls

from cconv.data.trajectory import Frame, ParticleType
from cconv.errors import ShapeError
from cconv.nn.kinds import Kinds
from cconv.tasks.features import fluid_state, kinds_of, make_inputs
from cconv.tasks.inputs import Units

NAMES = ("one", "density", "velocity")


@pytest.fixture
def state(generator):
    scene = periodic_scene()
    return fluid_state(periodic_frame(generator), scene.box, kernel(scene))


def inputs_of(frame, names=NAMES):
    scene = periodic_scene()
    return make_inputs(fluid_state(frame, scene.box, kernel(scene)), frame.boundary, scene, names)


def test_features_are_one_density_velocity_in_units_of_the_scene(state):
    inputs = make_inputs(state, None, periodic_scene(), NAMES)
    features = inputs.features
    assert features.names == NAMES
    assert features.kinds == kinds_of(NAMES) == Kinds(2, 1)
    assert torch.equal(features.scalars[:, 0], torch.ones(64))
    units = Units(length=1 / 8, density=1.0, time=0.01)  # masses are dx²
    assert inputs.units == units
    torch.testing.assert_close(inputs.positions, 8 * state.positions.float())
    torch.testing.assert_close(features.vectors[:, 0], 0.08 * state.velocities.float())
    torch.testing.assert_close(features.scalars[:, 1], state.densities.float())
    assert inputs.box.lengths == (8.0, 8.0)
    assert features.flat().dtype == torch.float32


def test_flat_features_have_the_scalars_first(state):
    features = make_inputs(state, None, periodic_scene(), NAMES).features
    assert torch.equal(features.flat(), torch.cat([features.scalars, features.vectors[:, 0]], dim=1))


def test_flat_features_become_features_of_the_same_names_again(state):
    features = make_inputs(state, None, periodic_scene(), NAMES).features
    again = features.with_values(2 * features.flat()[:5])
    assert again.names == features.names
    assert torch.equal(again.named("density"), 2 * features.scalars[:5, 1])
    assert torch.equal(again.named("velocity"), 2 * features.vectors[:5, 0])


def test_features_are_selected_by_name(generator):
    frame = with_walls(periodic_frame(generator))
    whole, bare = inputs_of(frame), inputs_of(frame, ("one", "velocity"))
    chosen = whole.features.select(("one", "velocity"))
    assert chosen.names == bare.features.names == ("one", "velocity")
    assert torch.equal(chosen.flat(), bare.features.flat())
    assert torch.equal(whole.positions, bare.positions)
    assert torch.equal(whole.wall_features.flat(), bare.wall_features.flat())
    with pytest.raises(ShapeError, match="takes the feature 'density', and the inputs hold one, velocity"):
        bare.features.select(NAMES)


def test_no_density_is_summed_for_features_without_it(generator):
    scene = periodic_scene()
    state = fluid_state(periodic_frame(generator), scene.box, kernel(scene))
    make_inputs(state, None, scene, ("one", "velocity"))
    assert "edges" not in vars(state)
    make_inputs(state, None, scene, NAMES)
    assert "edges" in vars(state)


def test_density_of_a_jittered_lattice_is_near_one(state):
    assert state.densities.mean().item() == pytest.approx(1, abs=0.05)


def test_what_is_known_of_a_state_is_not_computed(state):
    densities = torch.full((64,), 7.0, dtype=torch.float64)
    other = state.knowing(state.edges, densities)
    assert other.densities is densities
    assert other.edges is state.edges
    assert state.densities is not densities


def test_wall_features_are_normals_or_ones(generator):
    for normals, expected in ((True, torch.tensor([[0.0, 1.0]])), (False, torch.ones(1, 1))):
        walls = inputs_of(with_walls(periodic_frame(generator), normals)).wall_features
        torch.testing.assert_close(walls.flat(), expected.expand(8, -1).clone())
        assert walls.kinds == (Kinds(0, 1) if normals else Kinds(1, 0))


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
