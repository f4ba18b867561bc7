"""Slow continuous convolution in scalar arithmetic, written from the definition pair by pair.

Source of the definition: Open3D, CoordinateTransformation.h and ContinuousConv.h.
"""

import math

import numpy as np

WINDOWS = {
    "none": lambda q: 1.0,
    "poly6": lambda q: (1 - q * q) ** 3,
    "gaussian": lambda q: math.exp(-q * q),
    "cubic_spline": lambda q: 1 - 6 * q**2 + 6 * q**3 if q < 0.5 else 2 * (1 - q) ** 3,
}


def to_cube(q, mapping):
    """Map a point of the unit ball (3 numbers) to [-1/2, 1/2]^3."""
    x, y, z = q
    norm = math.sqrt(x * x + y * y + z * z)
    if mapping == "identity" or norm < 1e-6:
        return x / 2, y / 2, z / 2
    if mapping == "ball_to_cube_radial":
        largest = max(abs(x), abs(y), abs(z))
        return tuple(0.5 * value * norm / largest for value in q)
    if 5 / 4 * z * z > x * x + y * y:
        stretch = math.sqrt(3 * norm / (norm + abs(z)))
        x, y, z = stretch * x, stretch * y, math.copysign(norm, z)
    else:
        stretch = norm / math.sqrt(x * x + y * y)
        x, y, z = stretch * x, stretch * y, 1.5 * z
    rho = math.hypot(x, y)
    if rho < 1e-6:
        x = y = 0.0
    elif abs(y) <= abs(x):
        side = math.copysign(rho, x)
        x, y = side, side * 4 / math.pi * math.atan(y / x)
    else:
        side = math.copysign(rho, y)
        x, y = side * 4 / math.pi * math.atan(x / y), side
    return x / 2, y / 2, z / 2


def cells_along(g, size, interpolation):
    """(cell, weight) pairs along one axis."""
    if interpolation == "nearest_neighbor":
        nearest = math.floor(abs(g) + 0.5) * (1 if g >= 0 else -1)
        return [(min(max(nearest, 0), size - 1), 1.0)]
    if interpolation == "linear":
        lower = min(max(math.trunc(g), 0), size - 1)
        fraction = min(max(g - lower, 0.0), 1.0)
        return [(lower, 1 - fraction), (min(lower + 1, size - 1), fraction)]
    lower = math.floor(g)
    pairs = [(lower, 1 - (g - lower)), (lower + 1, g - lower)]
    return [(cell, weight) for cell, weight in pairs if 0 <= cell < size]


def loop_cconv(
    receivers_at, senders_at, features, filters, radius, *, mapping, window, interpolation, align_corners, normalize,
    ignore_index, message="absolute",
):  # fmt: skip
    """Convolution (N, C_out) of arrays in float64, 3D, open space; `ignore_index` leaves out pairs i == j."""
    depth, height, width, _, out_channels = filters.shape
    output = np.zeros((len(receivers_at), out_channels))
    for i, here in enumerate(receivers_at):
        psi = 0.0
        for j, there in enumerate(senders_at):
            q = (there - here) / radius
            distance = math.sqrt(float(q @ q))
            if distance > 1 or (ignore_index and i == j):
                continue
            importance = WINDOWS[window](distance)
            psi += importance
            cube = to_cube(q, mapping)
            grid = [
                (u + 0.5) * (size - 1) if align_corners else (u + 0.5) * size - 0.5
                for u, size in zip(cube, (width, height, depth), strict=True)
            ]
            own = {"absolute": 0, "difference": -1, "sum": 1}[message]
            value = features[j] + own * features[i] if own else features[j]
            for x, wx in cells_along(grid[0], width, interpolation):
                for y, wy in cells_along(grid[1], height, interpolation):
                    for z, wz in cells_along(grid[2], depth, interpolation):
                        output[i] += importance * wx * wy * wz * (value @ filters[z, y, x])
        if normalize and psi != 0:
            output[i] /= psi
    return output
