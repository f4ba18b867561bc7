"""Integrals over a ball, by Gauss's rule along the radius and rules of high order over the directions."""

import math

import numpy as np


def sphere_rule(dim, order=24):
    """Unit directions (S, D) and weights (S,) that sum to the measure of the unit sphere: 2, 2π or 4π."""
    if dim == 1:
        return np.array([[1.0], [-1.0]]), np.ones(2)
    angles = 2 * math.pi * np.arange(order) / order
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    if dim == 2:
        return circle, np.full(order, 2 * math.pi / order)
    heights, weights = np.polynomial.legendre.leggauss(order // 2)
    across = np.sqrt(1 - heights**2)[:, None, None] * circle
    up = np.broadcast_to(heights[:, None, None], (len(heights), order, 1))
    directions = np.concatenate([across, up], axis=2).reshape(-1, 3)
    return directions, np.repeat(weights * 2 * math.pi / order, order)


def radius_rule(knots, order=30):
    """Radii and weights of Gauss's rule on each interval between knots; the first begins at 0."""
    nodes, weights = np.polynomial.legendre.leggauss(order)
    starts, ends = np.array([0.0, *knots[:-1]]), np.array(knots)
    half = (ends - starts) / 2
    radii = (starts + half)[:, None] + half[:, None] * nodes
    return radii.ravel(), (half[:, None] * weights).ravel()


def ball_rule(knots, dim):
    """Points (Q, D) and weights (Q,) that integrate over the ball of radius ``knots[-1]``.

    Args:
        knots: Ascending radii between which the integrand is smooth.
        dim: Number of space dimensions, 1 to 3.
    """
    radii, radial_weights = radius_rule(knots)
    directions, directional_weights = sphere_rule(dim)
    points = radii[:, None, None] * directions
    weights = (radial_weights * radii ** (dim - 1))[:, None] * directional_weights
    return points.reshape(-1, dim), weights.ravel()
