import math

import pytest
import torch

from cconv.errors import ConfigError
from cconv.nn.filters import (
    INTERPOLATIONS,
    MAPPINGS,
    WINDOWS,
    corner_offsets,
    grid_coordinates,
    interpolate,
    map_ball_to_cube,
    strides,
    window_values,
)

# Positions in the unit ball, their volume-preserving and radial images u, and the volume-preserving grid coordinate
# for F = 4 with aligned corners; worked out by hand from Open3D's CoordinateTransformation.h.
VECTORS = [
    ((0.5, 0, 0), (0.25, 0, 0), (0.25, 0, 0), (2.25, 1.5, 1.5)),
    ((0.3, 0.4, 0.2), (0.220612, 0.269258, 0.15), (0.201944, 0.269258, 0.134629), (2.16184, 2.30777, 1.95)),
    ((0.1, -0.2, 0.8), (0.081591, -0.138212, 0.415331), (0.051916, -0.103833, 0.415331), (1.74477, 1.08536, 2.74599)),
    ((-0.6, 0.6, 0), (-0.424264, 0.424264, 0), (-0.424264, 0.424264, 0), (0.22721, 2.77279, 1.5)),
    ((0.2, 0.1, -0.3), (0.144266, 0.085165, -0.187083), (0.124722, 0.062361, -0.187083), (1.9328, 1.7555, 0.93875)),
    ((3**-0.5,) * 3, (0.5, 0.5, 0.433013), (0.5, 0.5, 0.5), (3, 3, 2.79904)),
]


def unit_ball(generator, count, dim):
    directions = torch.randn(count, dim, generator=generator, dtype=torch.float64)
    directions /= directions.norm(dim=1, keepdim=True)
    return directions * torch.rand(count, 1, generator=generator, dtype=torch.float64) ** (1 / dim)


def cells_and_weights(grid, sizes, interpolation):
    """Cells (E, P) that each grid coordinate reads and their weights (E, P)."""
    lowest, fractions, weight = interpolate(grid, sizes, interpolation)
    cells, weights = lowest.long() @ torch.tensor(strides(sizes)), weight[:, None]
    for axis in range(fractions.shape[1]):
        fraction = fractions[:, axis, None]
        weights = torch.cat([weights * (1 - fraction), weights * fraction], dim=1)
    return cells[:, None] + torch.tensor(corner_offsets(sizes)[: weights.shape[1]]), weights


@pytest.mark.parametrize(("ball", "volume_preserving", "radial", "grid"), VECTORS)
def test_open3d_test_vectors(ball, volume_preserving, radial, grid):
    ball = torch.tensor([ball], dtype=torch.float64)
    cube = map_ball_to_cube(ball, "ball_to_cube_volume_preserving")
    torch.testing.assert_close(cube, torch.tensor([volume_preserving], dtype=torch.float64), atol=1e-6, rtol=0)
    torch.testing.assert_close(
        map_ball_to_cube(ball, "ball_to_cube_radial"), torch.tensor([radial], dtype=torch.float64), atol=1e-6, rtol=0
    )
    torch.testing.assert_close(
        grid_coordinates(cube, (4, 4, 4), True), torch.tensor([grid], dtype=torch.float64), atol=1e-5, rtol=0
    )


@pytest.mark.parametrize("mapping", MAPPINGS)
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_maps_stay_in_the_cube_and_are_odd(mapping, dim, generator):
    ball = unit_ball(generator, 500, dim)
    cube = map_ball_to_cube(ball, mapping)
    assert cube.abs().max() <= 0.5 + 1e-12
    torch.testing.assert_close(map_ball_to_cube(-ball, mapping), -cube)


@pytest.mark.parametrize("mapping", MAPPINGS)
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_the_centre_maps_to_the_centre(mapping, dim):
    centre = torch.zeros(1, dim, dtype=torch.float64)
    assert torch.equal(map_ball_to_cube(centre, mapping), centre)


@pytest.mark.parametrize("dim", [2, 3])
def test_volume_preserving_map_has_a_constant_jacobian(dim, generator):
    ball = 0.9 * unit_ball(generator, 200, dim)
    jacobians = torch.func.vmap(
        torch.func.jacrev(lambda point: map_ball_to_cube(point[None], "ball_to_cube_volume_preserving")[0])
    )(ball)
    volume = {2: math.pi, 3: 4 * math.pi / 3}[dim]
    torch.testing.assert_close(torch.linalg.det(jacobians).abs(), torch.full((200,), 1 / volume, dtype=torch.float64))


@pytest.mark.parametrize("mapping", MAPPINGS)
def test_two_dimensions_are_three_at_height_zero(mapping, generator):
    disk = unit_ball(generator, 100, 2)
    in_space = torch.cat([disk, torch.zeros(100, 1, dtype=torch.float64)], dim=1)
    expected = map_ball_to_cube(in_space, mapping)
    torch.testing.assert_close(map_ball_to_cube(disk, mapping), expected[:, :2])
    assert expected[:, 2].abs().max() == 0


@pytest.mark.parametrize("window", WINDOWS)
def test_windows_start_at_one_and_decay(window):
    values = window_values(torch.linspace(0, 1, 101, dtype=torch.float64), window)
    assert values[0] == 1
    assert (values.diff() <= 1e-15).all()


@pytest.mark.parametrize(
    ("window", "edge"), [("none", 1), ("poly6", 0), ("gaussian", math.exp(-1)), ("cubic_spline", 0)]
)
def test_windows_at_the_radius(window, edge):
    assert window_values(torch.ones(1, dtype=torch.float64), window).item() == pytest.approx(edge, abs=1e-15)


@pytest.mark.parametrize("interpolation", ["linear", "nearest_neighbor"])
@pytest.mark.parametrize("sizes", [(4,), (3, 5), (4, 3, 2), (1, 1, 1)])
def test_weights_sum_to_one_inside_the_grid_of_clamping_interpolations(interpolation, sizes, generator):
    cube = torch.rand(50, len(sizes), generator=generator, dtype=torch.float64) - 0.5
    for align_corners in (True, False):
        cells, weights = cells_and_weights(grid_coordinates(cube, sizes, align_corners), sizes, interpolation)
        torch.testing.assert_close(weights.sum(1), torch.ones(50, dtype=torch.float64))
        assert cells.min() >= 0
        assert cells.max() < math.prod(sizes)


@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
def test_a_cell_centre_reads_that_cell_alone(interpolation):
    sizes = (3, 4, 2)
    x, y, z = 2, 1, 1
    cells, weights = cells_and_weights(torch.tensor([[x, y, z]], dtype=torch.float64), sizes, interpolation)
    read = torch.zeros(24, dtype=torch.float64).index_add_(0, cells[0], weights[0])
    expected = torch.zeros(24, dtype=torch.float64)
    expected[(z * 4 + y) * 3 + x] = 1
    assert torch.equal(read, expected)


def test_linear_interpolation_reproduces_a_linear_function(generator):
    sizes = (4, 5, 6)
    grid = torch.rand(40, 3, generator=generator, dtype=torch.float64) * (torch.tensor(sizes) - 1)
    z, y, x = torch.meshgrid(*(torch.arange(size, dtype=torch.float64) for size in sizes[::-1]), indexing="ij")
    table = (1 + 2 * x - 3 * y + 0.5 * z).flatten()
    cells, weights = cells_and_weights(grid, sizes, "linear")
    torch.testing.assert_close((table[cells] * weights).sum(1), 1 + grid @ grid.new_tensor([2, -3, 0.5]))


def test_linear_border_fades_out_beyond_the_outermost_centres():
    _, weights = cells_and_weights(torch.tensor([[-0.25]], dtype=torch.float64), (4,), "linear_border")
    assert weights.sum().item() == pytest.approx(0.75)


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda: map_ball_to_cube(torch.zeros(1, 2), "identiy"), "'identity'"),
        (lambda: window_values(torch.zeros(1), "poly"), "'poly6'"),
        (lambda: interpolate(torch.zeros(1, 1), (2,), "lineal"), "'linear'"),
    ],
)
def test_unknown_names_are_refused_with_the_nearest(call, name):
    with pytest.raises(ConfigError, match=f"Did you mean {name}"):
        call()
