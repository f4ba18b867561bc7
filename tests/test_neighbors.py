import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from oracles.brute_force_neighbors import brute_force_pairs

from cconv.batching import index_of
from cconv.domain import Box
from cconv.errors import ConfigError, ShapeError
from cconv.neighbors import half_list, radius_graph

LOWER, UPPER = (-0.5, 1.0, 0.2), (0.5, 2.5, 1.4)
AXES = [axes for dim in (1, 2, 3) for axes in itertools.product([False, True], repeat=dim)]
NEAR_HALF = 0.499

over_axes = pytest.mark.parametrize("periodic", AXES, ids=str)


def box_of(periodic):
    dim = len(periodic)
    return Box(LOWER[:dim], UPPER[:dim], periodic)


def cloud(generator, count, box, outside=0.0):
    """Points in the box, and beyond it by `outside` box lengths on each side."""
    unit = torch.rand(count, box.dim, dtype=torch.float64, generator=generator)
    return torch.tensor(box.lower) + torch.tensor(box.lengths) * ((1 + 2 * outside) * unit - outside)


def lattice(per_axis, dim):
    """Points at exact binary fractions: spacing 1/8."""
    axis = torch.arange(per_axis, dtype=torch.float64) / 8
    return torch.cartesian_prod(*[axis] * dim).reshape(-1, dim)


def assert_rows_are_compressed(edges):
    """The invariants of the row format."""
    assert edges.receivers.dtype == edges.senders.dtype == edges.row_splits.dtype == torch.int64
    assert edges.row_splits[0] == 0
    assert edges.row_splits[-1] == len(edges)
    counts = torch.bincount(edges.receivers, minlength=edges.num_receivers)
    assert torch.equal(edges.row_splits.diff(), counts)
    keys = edges.receivers * max(edges.num_senders, 1) + edges.senders
    assert (keys.diff() > 0).all()
    assert ((edges.senders >= 0) & (edges.senders < edges.num_senders)).all()


def assert_equals_brute_force(edges, positions, cutoff, box=None, queries=None, include_self=False):
    lengths = None
    if box is not None:
        lengths = [length if axis else None for length, axis in zip(box.lengths, box.periodic, strict=True)]
    expected = brute_force_pairs(positions, cutoff, lengths, queries, include_self)
    assert_rows_are_compressed(edges)
    assert list(zip(edges.receivers.tolist(), edges.senders.tolist(), strict=True)) == list(expected)
    displacements = torch.tensor(list(expected.values()), dtype=torch.float64).reshape(-1, positions.shape[1])
    torch.testing.assert_close(edges.displacements, displacements, atol=1e-13, rtol=0)
    torch.testing.assert_close(edges.distances, displacements.norm(dim=1), atol=1e-13, rtol=0)
    return len(expected)


@over_axes
@pytest.mark.parametrize("cutoff", [0.15, 0.35, NEAR_HALF])
@pytest.mark.parametrize("include_self", [False, True])
def test_cloud_equals_brute_force(periodic, cutoff, include_self, generator):
    box = box_of(periodic)
    positions = cloud(generator, 40, box)
    edges = radius_graph(positions, cutoff, box, include_self=include_self)
    assert assert_equals_brute_force(edges, positions, cutoff, box, include_self=include_self) > 10
    assert edges.includes_self == include_self
    assert not edges.bipartite


@over_axes
@pytest.mark.parametrize("cutoff", [0.15, NEAR_HALF])
def test_queries_equal_brute_force(periodic, cutoff, generator):
    box = box_of(periodic)
    positions, queries = cloud(generator, 30, box), cloud(generator, 20, box)
    queries[3] = positions[7]
    edges = radius_graph(positions, cutoff, box, queries)
    assert assert_equals_brute_force(edges, positions, cutoff, box, queries) > 5
    assert edges.bipartite
    assert not edges.includes_self
    assert (edges.num_receivers, edges.num_senders) == (20, 30)


@over_axes
def test_particles_that_left_the_box_equal_brute_force(periodic, generator):
    box = box_of(periodic)
    positions = cloud(generator, 40, box, outside=1.0)
    edges = radius_graph(positions, 0.4, box)
    assert assert_equals_brute_force(edges, positions, 0.4, box) > 5


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_open_space_equals_brute_force(dim, generator):
    positions = torch.randn(40, dim, dtype=torch.float64, generator=generator)
    assert assert_equals_brute_force(radius_graph(positions, 0.8), positions, 0.8) > 10


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("periodic", [False, True])
def test_cutoff_is_inclusive_on_a_lattice(dim, periodic):
    """Distances and cutoff are exact binary fractions, so that no rounding decides."""
    positions = lattice(4, dim)
    box = Box((0,) * dim, (0.5,) * dim, periodic)
    edges = radius_graph(positions, 1 / 8, box)
    assert_equals_brute_force(edges, positions, 1 / 8, box)
    if periodic:
        assert torch.equal(edges.row_splits.diff(), torch.full((4**dim,), 2 * dim))


def test_cutoff_of_half_the_box_lists_the_opposite_particle_once():
    positions = torch.tensor([[0.0], [0.5], [0.25]], dtype=torch.float64)
    edges = radius_graph(positions, 0.5, Box((0,), (1,), True))
    assert edges.receivers.tolist() == [0, 0, 1, 1, 2, 2]
    assert edges.senders.tolist() == [1, 2, 0, 2, 0, 1]
    assert edges.distances.tolist() == [0.5, 0.25, 0.5, 0.25, 0.25, 0.25]


@pytest.mark.parametrize("periodic", [False, True])
def test_particles_at_the_same_place_are_neighbours(periodic, generator):
    box = Box((0, 0), (1, 1), periodic)
    positions = cloud(generator, 10, box)
    positions[[4, 7]] = positions[2].clone()
    edges = radius_graph(positions, 0.2, box)
    assert_equals_brute_force(edges, positions, 0.2, box)
    pairs = list(zip(edges.receivers.tolist(), edges.senders.tolist(), strict=True))
    assert set(itertools.permutations([2, 4, 7], 2)) <= set(pairs)
    assert (2, 2) not in pairs


def test_images_of_one_place_are_neighbours_across_the_seam():
    positions = torch.tensor([[0.0], [1.0], [-1.0]], dtype=torch.float64)
    edges = radius_graph(positions, 0.1, Box((0,), (1,), True))
    assert torch.equal(edges.distances, torch.zeros(6, dtype=torch.float64))


@pytest.mark.parametrize("box", [None, Box((0, 0), (1, 1), True)], ids=["open", "periodic"])
@pytest.mark.parametrize("include_self", [False, True])
def test_one_particle(box, include_self):
    positions = torch.tensor([[0.3, 0.4]], dtype=torch.float64)
    edges = radius_graph(positions, 0.3, box, include_self=include_self)
    assert_equals_brute_force(edges, positions, 0.3, box, include_self=include_self)
    assert len(edges) == int(include_self)


@pytest.mark.parametrize("box", [None, Box((0, 0), (1, 1), True)], ids=["open", "periodic"])
@pytest.mark.parametrize("include_self", [False, True])
def test_no_particles(box, include_self):
    edges = radius_graph(torch.zeros(0, 2, dtype=torch.float64), 0.3, box, include_self=include_self)
    assert_rows_are_compressed(edges)
    assert len(edges) == edges.num_receivers == edges.num_senders == 0
    assert edges.displacements.shape == (0, 2)


@pytest.mark.parametrize("box", [None, Box((0, 0), (1, 1), True)], ids=["open", "periodic"])
@pytest.mark.parametrize(("senders", "receivers"), [(0, 3), (3, 0), (0, 0)])
def test_queries_without_partners(box, senders, receivers):
    positions = torch.full((senders, 2), 0.5, dtype=torch.float64)
    queries = torch.full((receivers, 2), 0.5, dtype=torch.float64)
    edges = radius_graph(positions, 0.3, box, queries)
    assert_rows_are_compressed(edges)
    assert (len(edges), edges.num_receivers, edges.num_senders) == (0, receivers, senders)
    assert edges.displacements.shape == (0, 2)


def test_displacement_points_from_sender_to_receiver():
    positions = torch.tensor([[0.0, 0.0], [0.3, 0.1]], dtype=torch.float64)
    edges = radius_graph(positions, 1.0)
    assert edges.receivers.tolist() == [0, 1]
    assert edges.displacements.tolist() == [[-0.3, -0.1], [0.3, 0.1]]


@over_axes
def test_full_list_holds_both_directions(periodic, generator):
    box = box_of(periodic)
    edges = radius_graph(cloud(generator, 60, box), 0.4, box)
    back = torch.argsort(edges.senders * edges.num_senders + edges.receivers)
    assert torch.equal(edges.receivers[back], edges.senders)
    assert torch.equal(edges.senders[back], edges.receivers)
    assert torch.equal(edges.displacements[back], -edges.displacements)
    assert torch.equal(edges.distances[back], edges.distances)


def test_queries_at_the_positions_see_what_particles_and_themselves_see(generator):
    box = Box((0, 0), (1, 1), (True, False))
    positions = cloud(generator, 50, box)
    own, asked = radius_graph(positions, 0.2, box, include_self=True), radius_graph(positions, 0.2, box, positions)
    assert torch.equal(own.receivers, asked.receivers)
    assert torch.equal(own.senders, asked.senders)
    assert torch.equal(own.displacements, asked.displacements)


@over_axes
def test_pairs_do_not_see_a_shift_across_the_seam(periodic, generator):
    box = box_of(periodic)
    positions = cloud(generator, 40, box)
    shift = 0.37 * torch.tensor(box.lengths, dtype=torch.float64) * torch.tensor(periodic)
    edges, shifted = radius_graph(positions, 0.3, box), radius_graph(box.wrap(positions + shift), 0.3, box)
    assert torch.equal(edges.receivers, shifted.receivers)
    assert torch.equal(edges.senders, shifted.senders)
    torch.testing.assert_close(edges.displacements, shifted.displacements)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("periodic", [False, True])
def test_dtype_is_kept(dtype, periodic, generator):
    box = Box((0, 0), (1, 1), periodic)
    positions = cloud(generator, 50, box).to(dtype)
    edges = radius_graph(positions, 0.2, box)
    assert edges.displacements.dtype == edges.distances.dtype == dtype
    assert len(edges) > 50
    assert edges.distances.max() <= 0.2 * (1 + 1e-6)


def test_conversion_changes_values_and_leaves_indices(generator):
    edges = radius_graph(torch.rand(30, 2, dtype=torch.float64, generator=generator), 0.3)
    single = edges.to(torch.float32)
    assert single.displacements.dtype == single.distances.dtype == torch.float32
    assert torch.equal(single.receivers, edges.receivers)
    assert torch.equal(single.row_splits, edges.row_splits)
    assert edges.displacements.dtype == torch.float64


def test_displacements_and_distances_are_differentiable(generator):
    box = Box((0, 0), (1, 1), True)
    positions = cloud(generator, 8, box).requires_grad_()
    queries = cloud(generator, 5, box).requires_grad_()

    def geometry(positions, queries):
        edges = radius_graph(positions, 0.4, box, queries)
        return edges.displacements, edges.distances

    assert len(geometry(positions, queries)[1]) > 5
    assert torch.autograd.gradcheck(geometry, (positions, queries))


@over_axes
def test_half_list_holds_each_pair_once(periodic, generator):
    box = box_of(periodic)
    positions = cloud(generator, 60, box, outside=0.3)
    edges = radius_graph(positions, 0.4, box)
    once = edges.receivers < edges.senders
    expected = torch.stack([edges.receivers[once], edges.senders[once]], dim=1)
    pairs = np.sort(half_list(positions, 0.4, box), axis=1)
    assert sorted(map(tuple, pairs.tolist())) == sorted(map(tuple, expected.tolist()))


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_few_particles_far_from_the_others(dim, generator):
    """Cells between and around them hold nothing, and cost nothing."""
    positions = torch.rand(40, dim, dtype=torch.float64, generator=generator)
    positions[3] += 1e6
    positions[[5, 11]] -= 1e12
    positions[17] = -1e300
    edges = radius_graph(positions, 0.3)
    assert assert_equals_brute_force(edges, positions, 0.3) > 10


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_groups_further_apart_than_cells_can_be_numbered(dim, generator):
    groups = torch.randint(3, (60, 1), generator=generator) * 1e7
    positions = groups + torch.rand(60, dim, dtype=torch.float64, generator=generator)
    assert assert_equals_brute_force(radius_graph(positions, 0.5), positions, 0.5) > 10


@over_axes
def test_many_cells_and_many_particles_in_a_cell(periodic, generator):
    """Cells of one particle and cells of a hundred, in one scene of some thirty cells along each axis."""
    box = box_of(periodic)
    positions = torch.cat([cloud(generator, 150, box), cloud(generator, 100, box) * 0.02 + torch.tensor(box.lower)])
    assert assert_equals_brute_force(radius_graph(positions, 0.03, box), positions, 0.03, box) > 1000


@over_axes
def test_same_with_and_without_gradients(periodic, generator):
    box = box_of(periodic)
    for dtype in (torch.float32, torch.float64):
        positions = cloud(generator, 50, box, outside=1.0).to(dtype)
        plain, tracked = (radius_graph(at, 0.4, box) for at in (positions, positions.clone().requires_grad_()))
        assert tracked.displacements.requires_grad
        assert not plain.displacements.requires_grad
        torch.testing.assert_close(tracked.displacements.detach(), plain.displacements, rtol=0, atol=0)
        torch.testing.assert_close(tracked.distances.detach(), plain.distances)


def test_points_in_any_memory_layout(generator):
    positions = torch.rand(3, 80, dtype=torch.float64, generator=generator).T
    torch.testing.assert_close(
        radius_graph(positions, 0.4).displacements, radius_graph(positions.contiguous(), 0.4).displacements
    )


def test_half_precision_finds_the_pairs_of_its_positions(generator):
    positions = torch.rand(80, 3, generator=generator).half()
    edges = radius_graph(positions, 0.4)
    assert edges.distances.dtype == edges.displacements.dtype == torch.float16
    assert torch.equal(edges.senders, radius_graph(positions.double(), 0.4).senders)


def test_pairs_that_do_not_fit_are_refused(generator):
    edges = radius_graph(torch.rand(30, 2, generator=generator), 0.3)
    edges.check()
    for changes in (
        {"receivers": edges.receivers + 30},
        {"senders": edges.senders - 1},
        {"row_splits": edges.row_splits.flip(0)},
        {"row_splits": edges.row_splits[:-1]},
    ):
        with pytest.raises(ShapeError, match="`edges` must list pairs among .* build them with `radius_graph`"):
            replace(edges, **changes).check()
    for bad in (math.nan, math.inf):
        with pytest.raises(ShapeError, match="`edges` must have finite displacements"):
            replace(edges, displacements=edges.displacements * bad).check()
    replace(edges, displacements=edges.displacements * 1e38).check()  # whose sum may not be finite


@pytest.mark.parametrize("name", ["positions", "queries"])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_coordinates_must_be_finite(name, bad):
    points = {"positions": torch.zeros(3, 2), "queries": torch.zeros(3, 2)}
    points[name][1, 0] = bad
    with pytest.raises(ShapeError, match=f"`{name}` must be finite"):
        radius_graph(points["positions"], 0.1, queries=points["queries"])


@pytest.mark.parametrize("name", ["positions", "queries"])
@pytest.mark.parametrize("shape", [(3,), (3, 0), (3, 4), (2, 3, 2)])
def test_points_must_have_one_to_three_axes(name, shape):
    points = {"positions": torch.zeros(3, 2), "queries": torch.zeros(3, 2), name: torch.zeros(shape)}
    with pytest.raises(ShapeError, match=rf"`{name}` must have shape \(particles, dim\).*got"):
        radius_graph(points["positions"], 0.1, queries=points["queries"])


def test_positions_must_be_floating_point():
    with pytest.raises(ShapeError, match="`positions` must be floating point, got torch.int64"):
        radius_graph(torch.zeros(3, 2, dtype=torch.int64), 0.1)


def test_queries_must_share_dimension_and_dtype():
    positions = torch.zeros(3, 2)
    with pytest.raises(ShapeError, match=r"`queries` must have shape \(queries, 2\), got \(3, 3\)"):
        radius_graph(positions, 0.1, queries=torch.zeros(3, 3))
    with pytest.raises(ShapeError, match="`queries` must share dtype and device"):
        radius_graph(positions, 0.1, queries=positions.double())


def test_box_must_have_the_positions_dimension():
    with pytest.raises(ShapeError, match=r"`box` must have as many axes as `positions` \(2\), got 3"):
        radius_graph(torch.zeros(3, 2), 0.1, Box((0, 0, 0), (1, 1, 1)))


@pytest.mark.parametrize("cutoff", [0.0, -1.0, math.nan])
def test_cutoff_must_be_positive(cutoff):
    with pytest.raises(ConfigError, match="`cutoff` must be positive"):
        radius_graph(torch.zeros(3, 2), cutoff)


def test_cutoff_must_not_pass_half_of_a_periodic_axis():
    box = Box((0, 0), (1, 4), (False, True))
    assert len(radius_graph(torch.zeros(1, 2), 2.0, box)) == 0
    with pytest.raises(ConfigError, match="at most half of every periodic axis, got 2.01 on axis 1 of length 4.0"):
        radius_graph(torch.zeros(1, 2), 2.01, box)


def test_include_self_with_queries_is_refused():
    points = torch.zeros(2, 2, dtype=torch.float64)
    with pytest.raises(ConfigError, match="include_self"):
        radius_graph(points, 0.1, queries=points, include_self=True)


def test_points_of_several_windows_see_their_own_window_alone(generator):
    """One window has no points, one has no queries, and the last has queries alone."""
    box, sizes, asked = box_of((True, False)), (30, 0, 12, 20, 0), (9, 4, 7, 0, 3)
    points, queries = ([cloud(generator, count, box) for count in counts] for counts in (sizes, asked))
    given = torch.cat(points), 0.2, box
    for edges, parts, counts in (
        (radius_graph(*given, batch_index=index_of(sizes)), [radius_graph(each, 0.2, box) for each in points], sizes),
        (
            radius_graph(
                *given, queries=torch.cat(queries), batch_index=index_of(sizes), query_batch_index=index_of(asked)
            ),
            [radius_graph(*pair) for pair in zip(points, [0.2] * 5, [box] * 5, queries, strict=True)],
            asked,
        ),
    ):
        edges.check()
        assert_rows_are_compressed(edges)
        assert (edges.num_receivers, edges.num_senders) == (sum(counts), sum(sizes))
        assert torch.equal(edges.batch_index, index_of(counts))
        assert torch.equal(edges.displacements, torch.cat([part.displacements for part in parts]))
        assert torch.equal(edges.distances, torch.cat([part.distances for part in parts]))
        firsts = [sum(sizes[:window]) for window in range(5)]
        senders = [part.senders + first for part, first in zip(parts, firsts, strict=True)]
        assert torch.equal(edges.senders, torch.cat(senders))
        assert torch.equal(edges.row_splits.diff(), torch.cat([part.row_splits.diff() for part in parts]))


def test_queries_and_their_batch_index_come_together(generator):
    points = torch.rand(4, 2, generator=generator)
    with pytest.raises(ShapeError, match="exactly with `queries`"):
        radius_graph(points, 0.2, queries=points, batch_index=index_of([4]))
    with pytest.raises(ShapeError, match="must come with `positions`"):
        radius_graph(points, 0.2, queries=points, query_batch_index=index_of([4]))


def test_pairs_at_the_same_place_can_be_left_out(generator):
    points = torch.rand(60, 2, generator=generator)
    points[:5] = points[5:10]
    edges = radius_graph(points, 0.2)
    apart = edges.apart()
    apart.check()
    assert (edges.distances == 0).sum() == len(edges) - len(apart) == 10
    kept = [pair for pair, distance in zip(pairs_of(edges), edges.distances, strict=True) if distance > 0]
    assert pairs_of(apart) == kept
    expected = torch.bincount(apart.receivers, minlength=60)
    assert torch.equal(apart.row_splits.diff(), expected)
    assert torch.equal(apart.neighbor_counts, expected)
    assert apart.apart() is apart


def test_a_particle_is_not_counted_among_its_neighbors(generator):
    points = torch.rand(60, 2, generator=generator)
    counts = [radius_graph(points, 0.2, include_self=among).neighbor_counts for among in (False, True)]
    assert torch.equal(*counts)


def pairs_of(edges):
    return list(zip(edges.receivers.tolist(), edges.senders.tolist(), strict=True))
