import itertools

import pytest
import torch
from simulated_device import simulated_device

from cconv import tensor_cell_list
from cconv.batching import index_of
from cconv.domain import Box
from cconv.neighbors import _pairs_on_device, radius_graph

LOWER, UPPER = (-0.5, 1.0, 0.2), (0.5, 2.5, 1.4)
AXES = [axes for dim in (1, 2, 3) for axes in itertools.product([False, True], repeat=dim)]


def cloud(generator, count, box, dtype=torch.float64):
    """Points in the box, and beyond it by half of it on each side."""
    unit = torch.rand(count, box.dim, dtype=dtype, generator=generator)
    return torch.tensor(box.lower, dtype=dtype) + torch.tensor(box.lengths, dtype=dtype) * (2 * unit - 0.5)


def assert_same_pairs(positions, cutoff, box=None, queries=None, include_self=False, windows=None):
    """The torch search lists exactly the pairs of the compiled one, in the same order; windows of both points."""
    asked, index = (None, None) if windows is None else windows
    known = radius_graph(positions, cutoff, box, queries, include_self, index, None if queries is None else asked)
    splits, rows, columns = _pairs_on_device(positions, queries, cutoff, box, include_self, windows)
    assert torch.equal(splits, known.row_splits)
    assert torch.equal(rows, known.receivers)
    assert torch.equal(columns, known.senders)
    return len(rows)


@pytest.mark.parametrize("periodic", AXES, ids=str)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_both_searches_find_the_same_pairs(periodic, dtype, generator):
    dim = len(periodic)
    box = Box(LOWER[:dim], UPPER[:dim], periodic)
    positions, queries = cloud(generator, 150, box, dtype), cloud(generator, 70, box, dtype)
    for cutoff in (0.05, 0.17, 0.26, 0.34, 0.499):  # axes of one, two, three and more cells
        assert_same_pairs(positions, cutoff, box)
        assert_same_pairs(positions, cutoff, box, include_self=True)
        assert_same_pairs(positions, cutoff, box, queries)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_a_lattice_whose_pairs_lie_at_the_cutoff_has_the_same_pairs(dim):
    axis = torch.arange(6, dtype=torch.float64) / 8
    positions = torch.cartesian_prod(*[axis] * dim).reshape(-1, dim)
    for periodic in (False, True):
        assert assert_same_pairs(positions, 1 / 8, Box((0,) * dim, (0.75,) * dim, periodic)) >= 2 * dim * 5**dim


def test_windows_do_not_see_each_other(generator):
    box = Box((0, 0), (1, 1), (True, False))
    positions, queries = cloud(generator, 120, box), cloud(generator, 50, box)
    windows = index_of([50, 0, 30, 40]), index_of([20, 5, 25])
    assert assert_same_pairs(positions, 0.3, box, windows=(windows[0], windows[0])) > 100
    assert assert_same_pairs(positions, 0.3, box, queries, windows=windows[::-1]) > 10


def test_points_far_away_and_at_the_same_place_are_found(generator):
    positions = torch.randn(60, 3, dtype=torch.float64, generator=generator)
    positions[7], positions[8:10] = 1e12, positions[3]
    positions[11] = positions[7] + 0.5
    assert assert_same_pairs(positions, 0.9) > 20


def test_there_may_be_no_points():
    for count, asked in ((0, 3), (3, 0), (0, 0), (1, 1)):
        assert_same_pairs(torch.zeros(count, 2), 0.5, queries=torch.ones(asked, 2))


def test_pairs_do_not_depend_on_how_many_candidates_are_measured_at_a_time(monkeypatch, generator):
    positions = torch.rand(300, 2, dtype=torch.float64, generator=generator)
    monkeypatch.setattr(tensor_cell_list, "_CANDIDATES", 37)  # fewer than some receivers have
    assert assert_same_pairs(positions, 0.1) > 1000


def test_the_search_stays_on_the_device(generator):
    positions = torch.rand(200, 3, generator=generator)
    box = Box((0, 0, 0), (1, 1, 1), (True, True, False))
    known = radius_graph(positions, 0.2, box)
    with simulated_device() as device:
        edges = radius_graph(positions.to(device), 0.2, box)
        assert edges.distances.device == edges.row_splits.device == device
        found = edges.to("cpu")
    assert torch.equal(found.senders, known.senders)
    assert torch.equal(found.row_splits, known.row_splits)
    torch.testing.assert_close(found.displacements, known.displacements, rtol=0, atol=0)
    torch.testing.assert_close(found.distances, known.distances)
