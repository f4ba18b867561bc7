"""Laws of the SPH relaxation: what must rest, symmetry, conservation, agreement with sums over all pairs."""

import math

import pytest
import torch
from oracles.dense_relaxation import dense_relax
from simulated_device import simulated_device

from cconv import Box, radius_graph
from cconv.errors import ConfigError, ShapeError, SimulationError
from cconv.scenes.walls import lattice
from cconv.sph import QuinticSpline, density, relax

SETTINGS = {"alpha": 0.02, "beta": 0.3, "loops": 3}


def uniform(shape, generator):
    """Numbers from -1 to 1, float64."""
    return 2 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1


def cloud(dim, generator, jitter=0.4, cells=None):
    """Particles shaken off a lattice that fills a periodic box, where they were a frame earlier, and the settings."""
    cells = cells or {2: 12, 3: 8}[dim]
    spacing = 0.1
    box = Box([-0.2] * dim, [-0.2 + cells * spacing] * dim, True)
    at_rest = lattice([cells] * dim, spacing, box.lower)
    positions = box.wrap(at_rest + jitter * spacing * uniform(at_rest.shape, generator))
    before = box.wrap(positions + 0.3 * spacing * uniform(at_rest.shape, generator))
    return positions, before, torch.zeros(len(positions), dtype=torch.bool), {"box": box, "particle_spacing": spacing}


def opened(box):
    return Box(box.lower, box.upper, False)


def spread(positions, scene):
    """Smallest distance and standard deviation of the density, in spacings and of the density at rest."""
    box, spacing = scene["box"], scene["particle_spacing"]
    edges = radius_graph(positions, 3 * spacing, box)
    masses = torch.full((len(positions),), spacing**box.dim, dtype=positions.dtype)
    return edges.distances.min() / spacing, density(masses, edges, QuinticSpline(spacing, box.dim)).std()


def relax_on_device(positions, before, is_wall, **settings):
    """The same on a device that has no compiled loops."""
    with simulated_device() as device:
        relaxed = relax(positions.to(device), before.to(device), is_wall.to(device), **settings)
        assert relaxed.device == device
        return relaxed.cpu()


@pytest.mark.parametrize("relaxed", [relax, relax_on_device])
@pytest.mark.parametrize("walls", [0, 9])
@pytest.mark.parametrize("periodic", [True, False])
@pytest.mark.parametrize("dim", [2, 3])
def test_it_is_the_sum_over_all_pairs(dim, periodic, walls, relaxed, generator):
    """Some walls move, as lids do, and one is far from the fluid."""
    positions, before, is_wall, scene = cloud(dim, generator)
    is_wall[:walls] = True
    if not periodic:
        scene["box"] = opened(scene["box"])
        positions[0] = 10.0
        before[0] = 10.1
    found = relaxed(positions, before, is_wall, **scene, **SETTINGS)
    expected = dense_relax(positions, before, is_wall, **scene, **SETTINGS)
    moved = scene["box"].displacement(expected, positions).abs().max()
    assert moved > 0.05 * scene["particle_spacing"]
    assert scene["box"].displacement(found, expected).abs().max() < 1e-6 * moved


@pytest.mark.parametrize("dim", [2, 3])
def test_a_lattice_rests(dim, generator):
    at_rest, _, is_wall, scene = cloud(dim, generator, jitter=0.0)
    shifts = relax(at_rest, at_rest, is_wall, **scene, **SETTINGS) - at_rest
    assert shifts.abs().max() < 1e-9 * scene["particle_spacing"]


@pytest.mark.parametrize("walls", [True, False])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_lattice_nearly_rests_where_it_ends_in_a_free_surface_or_a_layer_of_walls(dim, walls, generator):
    """The second row still has a density above 0.98, and below 1, because the row beyond the end is missing."""
    at_rest, _, is_wall, scene = cloud(dim, generator, jitter=0.0)
    is_wall[at_rest[:, 0] < scene["box"].lower[0] + scene["particle_spacing"]] = walls
    scene["box"] = Box(scene["box"].lower, scene["box"].upper, [False] + [True] * (dim - 1))
    shifts = relax(at_rest, at_rest, is_wall, **scene, **SETTINGS) - at_rest
    assert shifts.abs().max() < 0.01 * scene["particle_spacing"]


@pytest.mark.parametrize("dim", [2, 3])
def test_clusters_spread(dim, generator):
    positions, _, is_wall, scene = cloud(dim, generator, jitter=0.3)
    distance, deviation = spread(positions, scene)
    relaxed = relax(positions, positions, is_wall, **scene, alpha=0.02, loops=20)
    later_distance, later_deviation = spread(relaxed, scene)
    assert later_distance > 1.1 * distance
    assert later_deviation < 0.2 * deviation


def test_it_goes_on_from_where_it_ended(generator):
    """So many loops are as many relaxations of one loop, because the frame before stays the same."""
    positions, before, is_wall, scene = cloud(2, generator)
    together = relax(positions, before, is_wall, **scene, **SETTINGS)
    for _ in range(3):
        positions = relax(positions, before, is_wall, **scene, **SETTINGS | {"loops": 1})
    assert torch.allclose(together, positions, rtol=0, atol=1e-12)


def test_viscosity_takes_differences_of_velocity_away_and_keeps_their_mean(generator):
    positions, _, is_wall, scene = cloud(2, generator, jitter=0.0)
    displacements = scene["particle_spacing"] * 0.3 * uniform(positions.shape, generator)
    before = scene["box"].wrap(positions - displacements)
    relaxed = relax(positions, before, is_wall, **scene, alpha=0.02, beta=0.5)
    later = scene["box"].displacement(relaxed, before)
    assert later.var(dim=0).sum() < 0.95 * displacements.var(dim=0).sum()
    assert torch.allclose(later.mean(dim=0), displacements.mean(dim=0), rtol=0, atol=1e-12)


@pytest.mark.parametrize("dim", [2, 3])
def test_shifts_sum_to_zero_without_walls(dim, generator):
    positions, before, is_wall, scene = cloud(dim, generator)
    for box in (scene["box"], opened(scene["box"])):
        relaxed = relax(positions, before, is_wall, **scene | {"box": box}, **SETTINGS)
        shifts = box.displacement(relaxed, positions)
        assert shifts.sum(dim=0).abs().max() < 1e-12 * shifts.abs().sum()


def test_walls_and_isolated_particles_keep_their_places_exactly(generator):
    positions, before, is_wall, scene = cloud(2, generator)
    scene["box"] = opened(scene["box"])
    is_wall[::4] = True
    positions[1] = 5.0
    rests = is_wall.clone()
    rests[1] = True
    relaxed = relax(positions, before, is_wall, **scene, **SETTINGS)
    assert torch.equal(relaxed[rests], positions[rests])
    assert (relaxed != positions).any(dim=1)[~rests].all()


def beside_a_wall(gap, squeeze=1.0):
    """Fluid above one layer of walls, at a distance in spacings, and which of it is lowest and far from the sides."""
    spacing = 0.1
    walls, fluid = lattice([20, 1], spacing, (-1.0, -0.05)), lattice([12, 6], spacing, (-0.6, -0.05))
    fluid[:, 1] = squeeze * fluid[:, 1] + gap * spacing
    positions = torch.cat([walls, fluid])
    is_wall = torch.arange(len(positions)) < len(walls)
    lowest = ~is_wall & (positions[:, 1] < (gap + 0.5) * spacing) & (positions[:, 0].abs() < 0.3)
    scene = {"box": Box((-1.0, -1.0), (1.0, 1.0)), "particle_spacing": spacing}
    return positions, is_wall, lowest, scene


def test_a_layer_of_walls_pushes_away_what_is_nearer_than_a_spacing():
    positions, is_wall, lowest, scene = beside_a_wall(gap=0.6)
    shifts = relax(positions, positions, is_wall, **scene, alpha=0.02) - positions
    assert lowest.any()
    assert (shifts[lowest, 1] > 5e-4 * scene["particle_spacing"]).all()


def test_a_layer_of_walls_holds_fluid_under_pressure():
    positions, is_wall, lowest, scene = beside_a_wall(gap=0.9, squeeze=0.9)
    held = (relax(positions, positions, is_wall, **scene, alpha=0.02) - positions)[lowest, 1]
    fluid, none = positions[~is_wall], torch.zeros(int((~is_wall).sum()), dtype=torch.bool)
    free = (relax(fluid, fluid, none, **scene, alpha=0.02) - fluid)[lowest[~is_wall], 1]
    assert (free < -0.01 * scene["particle_spacing"]).all()
    assert (held.abs() < 0.5 * free.abs()).all()


def test_a_lid_drags_what_is_near_it(generator):
    positions, _, is_wall, scene = cloud(2, generator, jitter=0.0)
    is_wall[positions[:, 1] > 0.9] = True
    before = positions.clone()
    before[is_wall, 0] -= 0.2 * scene["particle_spacing"]
    scene["box"] = Box(scene["box"].lower, scene["box"].upper, [True, False])
    shifts = relax(positions, before, is_wall, **scene, **SETTINGS) - positions
    near = ~is_wall & (positions[:, 1] > 0.8)
    assert (shifts[near, 0] > 0).all()
    assert (shifts[positions[:, 1] < 0.2, 0].abs() < 1e-3 * shifts[near, 0].max()).all()


def test_it_moves_with_the_particles_through_periodic_faces(generator):
    positions, before, is_wall, scene = cloud(2, generator)
    is_wall[:5] = True
    box, by = scene["box"], torch.tensor([0.37, -0.81], dtype=torch.float64)
    there = relax(box.wrap(positions + by), box.wrap(before + by), is_wall, **scene, **SETTINGS)
    here = relax(positions, before, is_wall, **scene, **SETTINGS)
    assert box.displacement(there, here + by).abs().max() < 1e-12


@pytest.mark.parametrize("dim", [2, 3])
def test_it_turns_with_the_particles(dim, generator):
    positions, before, is_wall, scene = cloud(dim, generator)
    is_wall[:5] = True
    scene["box"] = opened(scene["box"])
    rotation = torch.linalg.qr(torch.randn(dim, dim, generator=generator, dtype=torch.float64))[0]
    turned = relax(positions @ rotation.T, before @ rotation.T, is_wall, **scene, **SETTINGS)
    expected = relax(positions, before, is_wall, **scene, **SETTINGS) @ rotation.T
    assert torch.allclose(turned, expected, rtol=0, atol=1e-12)


def test_the_order_of_particles_does_not_matter(generator):
    positions, before, is_wall, scene = cloud(2, generator)
    is_wall[:5] = True
    order = torch.randperm(len(positions), generator=generator)
    shuffled = relax(positions[order], before[order], is_wall[order], **scene, **SETTINGS)
    expected = relax(positions, before, is_wall, **scene, **SETTINGS)[order]
    assert scene["box"].displacement(shuffled, expected).abs().max() < 1e-12


def test_lengths_have_no_unit(generator):
    positions, before, is_wall, scene = cloud(2, generator)
    box = scene["box"]
    large = Box([1000 * low for low in box.lower], [1000 * high for high in box.upper], True)
    found = relax(
        1000 * positions,
        1000 * before,
        is_wall,
        box=large,
        particle_spacing=1000 * scene["particle_spacing"],
        **SETTINGS,
    )
    expected = 1000 * relax(positions, before, is_wall, **scene, **SETTINGS)
    assert large.displacement(found, expected).abs().max() < 1e-9


def test_single_precision_is_the_same_to_its_rounding(generator):
    positions, before, is_wall, scene = cloud(2, generator)
    single = relax(positions.float(), before.float(), is_wall, **scene, **SETTINGS)
    double = relax(positions.float().double(), before.float().double(), is_wall, **scene, **SETTINGS)
    assert single.dtype == torch.float32
    assert scene["box"].displacement(single.double(), double).abs().max() < 1e-6
    assert (single < torch.tensor(scene["box"].upper)).all()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"alpha": -0.1}, "`alpha` of a relaxation must be a number from 0 on, got -0.1"),
        ({"beta": math.nan}, "`beta` of a relaxation must be a number from 0 on, got nan"),
        ({"loops": 0}, "`loops` of a relaxation must be at least 1, got 0"),
        ({"particle_spacing": 0.0}, "`particle_spacing` must be positive, got 0"),
        ({"particle_spacing": 0.5}, "`box` must be at least 3.3 long on its periodic axis 0"),
    ],
)
@pytest.mark.parametrize("relaxed", [relax, relax_on_device])
def test_settings_that_cannot_be_are_refused(changed, message, relaxed, generator):
    positions, before, is_wall, scene = cloud(2, generator)
    with pytest.raises(ConfigError, match=message):
        relaxed(positions, before, is_wall, **scene | SETTINGS | changed)


@pytest.mark.parametrize("name", ["positions", "before", "is_wall"])
def test_shapes_that_do_not_fit_are_named(name, generator):
    positions, before, is_wall, scene = cloud(2, generator)
    given = {"positions": positions, "before": before, "is_wall": is_wall}
    given[name] = given[name][:-1]
    with pytest.raises(ShapeError, match="must have shape"):
        relax(**given, **scene, **SETTINGS)


def test_positions_that_are_not_finite_are_refused(generator):
    positions, before, is_wall, scene = cloud(2, generator)
    positions[3, 0] = math.nan
    with pytest.raises(ShapeError, match="must be finite"):
        relax(positions, before, is_wall, **scene, **SETTINGS)


@pytest.mark.parametrize("relaxed", [relax, relax_on_device])
def test_a_shift_of_more_than_a_spacing_is_no_relaxation(relaxed, generator):
    positions, before, is_wall, scene = cloud(2, generator)
    with pytest.raises(SimulationError, match="alpha 5 shifted a particle by .* particle spacings in one loop"):
        relaxed(positions, before, is_wall, **scene, alpha=5.0)
