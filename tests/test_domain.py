import itertools

import pytest
import torch
from oracles.brute_force_neighbors import shortest_along

from cconv.domain import Box
from cconv.errors import ShapeError

LOWER, UPPER = (-1.0, 2.0, 0.25), (1.0, 5.0, 0.75)
AXES = [axes for dim in (1, 2, 3) for axes in itertools.product([False, True], repeat=dim)]

over_axes = pytest.mark.parametrize("periodic", AXES, ids=str)


def box_of(periodic):
    dim = len(periodic)
    return Box(LOWER[:dim], UPPER[:dim], periodic)


def points_around(box, count, generator):
    """Points up to one box length outside of the box."""
    lower, lengths = torch.tensor(box.lower), torch.tensor(box.lengths)
    inside = torch.rand(count, box.dim, dtype=torch.float64, generator=generator)
    return lower + lengths * (3 * inside - 1)


def test_lengths_and_dimension():
    box = Box(LOWER, UPPER)
    assert box.lengths == (2.0, 3.0, 0.5)
    assert box.dim == 3


def test_one_truth_value_holds_for_all_axes():
    assert Box(LOWER, UPPER, True) == Box(LOWER, UPPER, (True, True, True))
    assert Box(LOWER, UPPER) == Box(LOWER, UPPER, (False, False, False))


def test_box_is_a_value():
    assert Box([0, 0], [1, 2], [True, False]) == Box((0.0, 0.0), (1.0, 2.0), (True, False))
    assert hash(Box((0,), (1,))) == hash(Box((0.0,), (1.0,)))
    with pytest.raises(AttributeError):
        Box((0,), (1,)).lower = (2.0,)


@over_axes
def test_displacement_is_the_shortest_image(periodic, generator):
    box = box_of(periodic)
    to, origin = points_around(box, 40, generator), points_around(box, 40, generator)
    lengths = [length if axis else None for length, axis in zip(box.lengths, periodic, strict=True)]
    expected = [
        [shortest_along(value, length) for value, length in zip(row, lengths, strict=True)]
        for row in (to - origin).tolist()
    ]
    torch.testing.assert_close(box.displacement(to, origin), torch.tensor(expected, dtype=torch.float64))


@over_axes
def test_displacement_turns_with_its_ends(periodic, generator):
    box = box_of(periodic)
    to, origin = points_around(box, 40, generator), points_around(box, 40, generator)
    assert torch.equal(box.displacement(to, origin), -box.displacement(origin, to))
    assert torch.equal(box.displacement(to, to), torch.zeros_like(to))


@over_axes
def test_displacement_and_wrap_do_not_see_whole_box_lengths(periodic, generator):
    box = box_of(periodic)
    to, origin = points_around(box, 40, generator), points_around(box, 40, generator)
    images = torch.randint(-3, 4, (40, box.dim), generator=generator)
    shift = images * torch.tensor(box.lengths, dtype=torch.float64) * torch.tensor(periodic)
    torch.testing.assert_close(box.displacement(to + shift, origin), box.displacement(to, origin))
    torch.testing.assert_close(box.displacement(box.wrap(to), origin), box.displacement(to, origin))
    torch.testing.assert_close(box.wrap(to + shift), box.wrap(to))


@over_axes
def test_wrap_brings_periodic_axes_inside_and_leaves_open_ones(periodic, generator):
    box = box_of(periodic)
    points = points_around(box, 200, generator)
    wrapped = box.wrap(points)
    axes = torch.tensor(periodic)
    lower, upper = (torch.tensor(bound, dtype=torch.float64) for bound in (box.lower, box.upper))
    assert ((wrapped >= lower) & (wrapped < upper) | ~axes).all()
    assert torch.equal(wrapped[:, ~axes], points[:, ~axes])
    torch.testing.assert_close(box.wrap(wrapped), wrapped)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("start", [0.0, -1.0])
def test_wrap_at_the_seam(start, dtype):
    box = Box((start,), (start + 1,), True)
    points = torch.tensor([[start], [start + 1], [start - 1], [start - 1e-30]], dtype=dtype)
    assert torch.equal(box.wrap(points), torch.full((4, 1), start, dtype=dtype))


def test_displacement_broadcasts():
    box = Box((0, 0), (1, 1), True)
    points = torch.tensor([[0.1, 0.1], [0.9, 0.5]], dtype=torch.float64)
    pairs = box.displacement(points[:, None], points[None, :])
    assert pairs.shape == (2, 2, 2)
    torch.testing.assert_close(pairs[0, 1], torch.tensor([0.2, -0.4], dtype=torch.float64))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("periodic", [False, True])
def test_dtype_is_kept(dtype, periodic):
    box = Box((0, 0), (1, 1), periodic)
    points = torch.full((3, 2), 0.7, dtype=dtype)
    assert box.displacement(points, points / 7).dtype == dtype
    assert box.wrap(points).dtype == dtype


def test_displacement_and_wrap_are_differentiable(generator):
    box = Box((0, 0), (1, 1), (True, False))
    to, origin = (torch.rand(5, 2, dtype=torch.float64, generator=generator).requires_grad_() for _ in ("to", "origin"))
    assert torch.autograd.gradcheck(box.displacement, (to, origin))
    assert torch.autograd.gradcheck(box.wrap, (to + 1.0,))


@pytest.mark.parametrize(
    ("lower", "upper", "periodic"),
    [((0, 0), (1,), False), ((0,), (1, 1), False), ((0, 0), (1, 1), (True,)), ((0,), (1,), (True, False))],
)
def test_bounds_must_have_one_entry_an_axis(lower, upper, periodic):
    with pytest.raises(ShapeError, match="one entry an axis"):
        Box(lower, upper, periodic)


@pytest.mark.parametrize(("lower", "upper"), [((0, 1), (1, 1)), ((2,), (1,)), ((float("nan"),), (1,))])
def test_upper_must_lie_above_lower(lower, upper):
    with pytest.raises(ShapeError, match="`upper` must lie above `lower`"):
        Box(lower, upper)


@pytest.mark.parametrize(("lower", "dtype"), [(1.0, torch.float64), (512.0, torch.float32)])
def test_wrap_stays_below_the_upper_bound_where_rounding_would_reach_it(lower, dtype):
    just_outside = torch.nextafter(torch.tensor([[lower]], dtype=dtype), torch.tensor(0.0, dtype=dtype))
    wrapped = Box((lower,), (lower + 1,), True).wrap(just_outside)
    assert lower <= wrapped.item() < lower + 1


def test_a_periodic_axis_without_end_is_refused():
    with pytest.raises(ShapeError, match="finite on a periodic axis"):
        Box((0.0,), (float("inf"),), True)
