"""Neighbours by looking at every pair, in scalar arithmetic and double precision."""

import math

IMAGES = range(-4, 5)


def shortest_along(difference, length):
    """The shortest of the periodic images of a difference along one axis; `length` is None on an open axis."""
    if length is None:
        return difference
    return min((difference + image * length for image in IMAGES), key=abs)


def brute_force_pairs(positions, cutoff, lengths=None, queries=None, include_self=False):
    """Pairs within `cutoff`, for points less than three box lengths apart.

    Args:
        positions: Sending points, M rows of D numbers.
        cutoff: Largest distance, inclusive.
        lengths: Length of every axis, None for an open one; None for open space.
        queries: Receiving points; by default the positions, which then do not see themselves.
        include_self: Whether they do.

    Returns:
        A dict (receiver, sender) -> displacement from sender to receiver, in the order of the keys.
    """
    positions = [list(map(float, point)) for point in positions]
    receivers = positions if queries is None else [list(map(float, point)) for point in queries]
    pairs = {}
    for i, here in enumerate(receivers):
        for j, there in enumerate(positions):
            if queries is None and i == j and not include_self:
                continue
            displacement = [
                shortest_along(a - b, length)
                for a, b, length in zip(here, there, lengths or [None] * len(here), strict=True)
            ]
            if math.hypot(*displacement) <= cutoff:
                pairs[i, j] = displacement
    return pairs
